"""A film of an agent: what happens, below with the return and the cost so far."""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_guard.algorithms.common.constrained import Constrained
from sb3_guard.common.files import replacing
from sb3_guard.common.monitor import cost_keys_of
from sb3_guard.common.native import GuardVecEnv
from sb3_guard.costs import read_costs
from sb3_guard.zoo.cli.usage import UsageError, explained

FPS = 25  # pictures a second are enough
HELD = 1.0  # s, how long the last picture of an episode stays
INK, RED = (40, 40, 40), (200, 0, 0)


class Film(VecEnvWrapper):
    """
    One environment whose pictures are written as it is stepped.

    The last picture of an episode stays for a second, with its return and cost.

    :param venv: one environment
    :param model: whose costs and limits are said
    :param writer: is sent the pictures, [height, width, 3] uint8
    :param bar: a progress bar, of steps
    """

    def __init__(self, venv: VecEnv, model: BaseAlgorithm, writer: Any, bar: Any) -> None:
        super().__init__(venv)
        self.writer, self.bar = writer, bar
        self.keys = cost_keys_of(model, venv)
        self.limits: list[float | None] = [None] * len(self.keys)
        if isinstance(model, Constrained) and model.constrained:
            self.limits = model.final_cost_limits.tolist()
        self.worst = getattr(model, "limit_on", "sum") == "max"
        self.every = _steps_per_picture(venv)
        self.steps = 0
        self.latest = np.zeros((0, 0, 3), np.uint8)
        self._begin()

    def _begin(self) -> None:
        self.earned, self.costs = 0.0, np.zeros(len(self.keys))

    def reset(self) -> VecEnvObs:
        """Begin an episode; nothing is written."""
        self._begin()
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Pass a step on, and write its pictures."""
        obs, rewards, dones, infos = self.venv.step_wait()
        self.earned += float(rewards[0])
        costs = read_costs(infos, self.keys, zero_if_missing=True)[0][0]
        self.costs = np.maximum(self.costs, costs) if self.worst else self.costs + costs
        words = self.words()
        self.bar.update()
        self.bar.set_postfix_str("   ".join(text for text, _ in words), refresh=False)
        if dones[0]:  # what is seen by now is the next episode
            self._write(words, [self.latest] * round(HELD * _fps(self.venv) / self.every))
            self._begin()
        elif self.steps % self.every == 0:
            self._write(words, _pictures(self.venv))
        self.steps += 1
        return obs, rewards, dones, infos

    def _write(self, words: Sequence[tuple[str, bool]], pictures: Sequence[np.ndarray]) -> None:
        for picture in pictures:
            if picture.size:  # none was taken if an episode ends in its first step
                self.writer.send(np.ascontiguousarray(below(words, picture)))
                self.latest = picture

    def words(self) -> list[tuple[str, bool]]:
        """Return and each cost of the episode so far, and whether a limit is exceeded."""
        texts = [(f"return {self.earned:z.2f}", False)]
        for key, cost, limit in zip(self.keys, self.costs.tolist(), self.limits, strict=True):
            name = f"worst {key} of a step" if self.worst else key
            end = "" if limit is None else f", limit {limit:g}"
            texts.append((f"{name} {cost:.2f}{end}", limit is not None and cost > limit))
        return texts


def below(words: Sequence[tuple[str, bool]], picture: np.ndarray) -> np.ndarray:
    """
    A picture below a line of text; it has an even number of pixels each way, as videos need.

    :param words: texts, and whether each is red
    :param picture: shape [height, width, 3], uint8
    """
    from PIL import Image, ImageDraw, ImageFont

    height, width = picture.shape[:2]
    size = max(8, min(24, width // 40))  # pixels
    band = 2 * size
    page = Image.new("RGB", (width + width % 2, height + height % 2 + band), "white")
    page.paste(Image.fromarray(picture), (0, band))
    draw, font, x = ImageDraw.Draw(page), ImageFont.load_default(size), size // 2
    for text, red in words:
        draw.text((x, size // 3), text, RED if red else INK, font)
        x += int(draw.textlength(text, font)) + 2 * size
    return np.asarray(page)


@contextmanager
def filming(env: VecEnv, model: BaseAlgorithm, video: Path, bar: bool = False) -> Iterator[Film]:
    """
    The environment in which to play an agent that is filmed.

    The first picture is taken at once, so that a machine that can't render says so before anything
    is played, and nothing is written then.

    :param env: one environment
    :param video: mp4 to write
    :param bar: show how many steps have been played, if stderr is a terminal
    :raises UsageError: no picture can be rendered, or the file can't be written
    """
    import imageio_ffmpeg
    from tqdm import tqdm

    env.reset()
    first = render(env)
    if first is None:
        raise UsageError("this environment renders no rgb_array frames; it can't be recorded")
    height, width = below([], first).shape[:2]
    fps = _fps(env) / _steps_per_picture(env)
    video.parent.mkdir(parents=True, exist_ok=True)
    with (
        explained(f"can't write {video}", OSError),
        replacing(video) as file,
        tqdm(desc="Filming", unit=" steps", leave=False, disable=None if bar else True) as progress,
    ):
        writer = imageio_ffmpeg.write_frames(
            file.name, (width, height), fps=fps, macro_block_size=2, output_params=["-f", "mp4"]
        )
        writer.send(None)
        with closing(writer):
            yield Film(env, model, writer, progress)


def render(env: VecEnv) -> np.ndarray | None:
    """
    A picture of one environment, or None where it is shown in a window.

    :raises UsageError: it can't be rendered
    """
    if env.render_mode == "human":
        env.render()
        return None
    with explained("can't render", RuntimeError, ImportError, AttributeError):
        return env.get_images()[0]


def _pictures(env: VecEnv) -> list[np.ndarray]:
    """The pictures of one step: several where a control step of sb3_guard is long."""
    native = env.unwrapped
    return native.film() if isinstance(native, GuardVecEnv) else [render(env)]  # type: ignore[list-item]


def _steps_per_picture(env: VecEnv) -> int:
    return max(1, int(_fps(env) / FPS))


def _fps(env: VecEnv) -> float:
    """Pictures a second as fast as it happens, one or more a step."""
    if isinstance(env.unwrapped, GuardVecEnv):
        return env.unwrapped.envs.film_fps
    try:
        return float(env.get_attr("metadata")[0].get("render_fps", 30))
    except AttributeError:
        return 30.0
