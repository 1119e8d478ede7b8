"""A film of an agent: what happens, below a line with the return and the costs so far.

Gymnasium's and SB3's recorders keep all pictures of an episode in memory, some 2 GB of a thousand
at this size; here each is written as it is taken.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard.common.files import replacing
from sb3_guard.common.monitor import find_monitor
from sb3_guard.judging import Limits
from sb3_guard.zoo.cli.usage import UsageError, explained


def caption(env: VecEnv, model: BaseAlgorithm | None) -> str:
    """
    Return and each cost of the episode so far, beside its limit.

    :param env: one environment, in a ``CostMonitor``
    :param model: whose limits are said
    """
    monitor = find_monitor(env)
    limits, episodes = Limits.of(model, monitor.cost_keys), monitor.episodes
    costs = (episodes.highest if limits.on == "max" else episodes.totals)[0, -len(limits.keys) :]
    words = [f"return {monitor.episode_returns[0]:z.2f}"]
    for name, cost, limit in zip(limits.names, costs, limits.values, strict=True):
        words.append(f"{name} {cost:.2f}" + f" (limit {limit:g})" * bool(np.isfinite(limit)))
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
def filming(env: VecEnv, model: BaseAlgorithm | None, video: Path) -> Iterator[Callable[[], None]]:
    """
    What writes the picture of a step that was taken: ``evaluate_policy(…, on_step=film)``.

    The first picture is taken at once, so that a machine that can't render says so before anything
    is played, and nothing is written then.

    :param env: one environment, in a ``CostMonitor``
    :param model: whose limits are said
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
        metadata = env.get_attr("metadata")[0] if env.has_attr("metadata") else {}
        fps = float(metadata.get("render_fps", 30))
        writer = imageio_ffmpeg.write_frames(
            file.name, (width, height), fps=fps, macro_block_size=2,
            output_params=["-f", "mp4"],
        )  # fmt: skip
        writer.send(None)

        def film() -> None:
            if steps := find_monitor(env).episodes.lengths[0]:  # else it is of the next by now
                picture: Any = render(env)
                writer.send(np.ascontiguousarray(below(caption(env, model), picture)))
                if steps % 100 == 0:
                    print(f"filmed {steps} steps", file=sys.stderr)

        with closing(writer):
            yield film


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
