"""A film of an agent: what happens, below a line with the return and the costs so far.

Gymnasium's and SB3's recorders keep all pictures of an episode in memory, some 2 GB of a thousand
at this size; here each is written as it is taken.
"""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_guard.algorithms.common.constrained import Constrained
from sb3_guard.common.files import replacing
from sb3_guard.common.monitor import cost_keys_of
from sb3_guard.common.native import GuardVecEnv
from sb3_guard.costs import EpisodeCosts, bounded_name, read_costs
from sb3_guard.zoo.cli.usage import UsageError, explained


class Film(VecEnvWrapper):
    """
    One environment whose pictures are written as it is stepped.

    :param venv: one environment
    :param model: whose costs and limits are said
    :param writer: is sent the pictures, [height, width, 3] uint8
    """

    def __init__(self, venv: VecEnv, model: BaseAlgorithm, writer: Any) -> None:
        super().__init__(venv)
        self.writer, self.keys = writer, cost_keys_of(model, venv)
        limited = isinstance(model, Constrained) and model.constrained
        self.limits = model.final_cost_limits.tolist() if limited else [None] * len(self.keys)  # type: ignore[attr-defined]
        self.limit_on = getattr(model, "limit_on", "sum")
        self.total, self.costs = 0.0, EpisodeCosts(1, len(self.keys))

    def reset(self) -> VecEnvObs:
        """Begin an episode; nothing is written."""
        self.total, self.costs = 0.0, EpisodeCosts(1, len(self.keys))
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Pass a step on, and write its pictures."""
        obs, rewards, dones, infos = self.venv.step_wait()
        self.total += float(rewards[0])
        self.costs.step(read_costs(infos, self.keys, zero_if_missing=True)[0], dones)
        if dones[0]:  # pictures are of the next episode by now
            self.total = 0.0
        else:
            native = self.venv.unwrapped  # of which long control steps have several pictures
            shots: list[Any] = (
                native.film() if isinstance(native, GuardVecEnv) else [render(self.venv)]
            )
            for picture in shots:
                self.writer.send(np.ascontiguousarray(below(self.caption(), picture)))
        return obs, rewards, dones, infos

    def caption(self) -> str:
        """Return and each cost of the episode so far, beside its limit."""
        words, costs = [f"return {self.total:z.2f}"], self.costs
        bounded = costs.highest if self.limit_on == "max" else costs.totals
        for key, cost, limit in zip(self.keys, bounded[0].tolist(), self.limits, strict=True):
            name = bounded_name(key, self.limit_on)
            words.append(f"{name} {cost:.2f}" + ("" if limit is None else f" (limit {limit:g})"))
        return "    ".join(words)


def below(text: str, picture: np.ndarray) -> np.ndarray:
    """
    A picture below a line of text; it has an even number of pixels each way, as videos need.

    :param picture: shape [height, width, 3], uint8
    """
    height, width = picture.shape[:2]
    size = max(8, min(24, width // 40))  # pixels
    page = Image.new("RGB", (width + width % 2, height + height % 2 + 2 * size), "white")
    page.paste(Image.fromarray(picture), (0, 2 * size))
    font = ImageFont.load_default(size)
    ImageDraw.Draw(page).text((size // 2, size // 3), text, "black", font)
    return np.asarray(page)


@contextmanager
def filming(env: VecEnv, model: BaseAlgorithm, video: Path) -> Iterator[Film]:
    """
    The environment in which to play an agent that is filmed.

    The first picture is taken at once, so that a machine that can't render says so before anything
    is played, and nothing is written then.

    :param env: one environment
    :param video: mp4 to write
    :raises UsageError: no picture can be rendered, or the file can't be written
    """
    env.reset()
    first = render(env)
    if first is None:
        raise UsageError("this environment renders no rgb_array frames; it can't be recorded")
    height, width = below("", first).shape[:2]
    video.parent.mkdir(parents=True, exist_ok=True)
    with explained(f"can't write {video}", OSError), replacing(video) as file:
        if isinstance(env.unwrapped, GuardVecEnv):
            fps: float = env.unwrapped.envs.film_fps
        else:
            metadata = env.get_attr("metadata")[0] if env.has_attr("metadata") else {}
            fps = float(metadata.get("render_fps", 30))
        writer = imageio_ffmpeg.write_frames(
            file.name, (width, height), fps=fps, macro_block_size=2,
            output_params=["-f", "mp4"],
        )  # fmt: skip
        writer.send(None)
        with closing(writer):
            yield Film(env, model, writer)


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
