"""A run at Weights & Biases: its TensorBoard events are sent there as they are written."""

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_guard.zoo.cli.usage import explained, one_line
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder


class Tracker:
    """
    What ``--track`` does: it logs in before the first event file is opened, or its events would
    not be seen, and before a new run has a folder, so that a refusal leaves nothing behind.

    :param flags: all flags of the run
    :param hyperparams: its hyperparameters
    :param folder: the folder of a run that is resumed, which remembers the id
    :raises UsageError: Weights & Biases refuses, e.g. for want of a key or a network
    """

    def __init__(
        self, flags: RunFlags, hyperparams: Mapping[str, Any], folder: RunFolder | None = None
    ):
        import wandb

        known = folder and _remembered(folder).exists() and _remembered(folder).read_text().strip()
        name = f"{flags.env}__{flags.algo}__{flags.seed}__{int(time.time())}"
        fix = "log in with: wandb login, set WANDB_MODE=offline, or leave out --track"
        with explained("--track: Weights & Biases can't be used", fix=fix):
            self._run: Any = wandb.init(
                id=known or None,
                resume="allow" if known else None,
                name=None if known else name,
                project=flags.wandb_project_name,
                entity=flags.wandb_entity,
                group=flags.wandb_group,
                tags=flags.wandb_tags,
                config={**flags.values(), "hyperparams": hyperparams},
                sync_tensorboard=True,
            )

    def remember(self, folder: RunFolder) -> None:
        """Keep the id in the run's folder, and the folder at Weights & Biases."""
        _remembered(folder).write_text(self._run.id)
        self._run.config.update({"folder": str(folder.path)}, allow_val_change=True)

    def finish(self) -> None:
        """Let Weights & Biases have what it has not yet."""
        try:
            self._run.finish()
        except Exception as error:  # its client raises what it likes; the run is on disk
            print(
                f"--track: Weights & Biases did not get everything: {one_line(error)}; "
                "send it with: wandb sync",
                file=sys.stderr,
            )


def _remembered(folder: RunFolder) -> Path:
    return folder.params / "wandb.txt"
