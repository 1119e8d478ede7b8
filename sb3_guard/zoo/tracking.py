"""A run at Weights & Biases: its TensorBoard events are sent there as they are written."""

import sys
import time
from collections.abc import Mapping
from typing import Any

from sb3_guard.zoo.run_flags import RunFlags
from sb3_guard.zoo.run_folder import RunFolder
from sb3_guard.zoo.usage import explained, one_line


class Tracker:
    """
    What ``--track`` does.

    :param flags: all flags of the run
    :param hyperparams: its hyper-parameters
    """

    def __init__(self, flags: RunFlags, hyperparams: Mapping[str, Any]):
        self.flags = flags
        self.hyperparams = hyperparams
        self._run: Any = None

    def begin(self, folder: RunFolder | None = None, resumed: bool = False) -> None:
        """
        Log in, before the first event file is opened, or its events would not be seen.

        For a new run this is called before its folder is made, so that a refusal leaves nothing
        behind, and again when there is a folder.

        :param folder: the run's, which remembers the id
        :param resumed: continue the run of that id
        :raises UsageError: Weights & Biases refuses, e.g. for want of a key or a network
        """
        path = None if folder is None else folder.params / "wandb.txt"
        if self._run is None:
            import wandb

            flags, known = self.flags, None
            if resumed and path is not None and path.exists():
                known = path.read_text().strip()
            name = f"{flags.env}__{flags.algo}__{flags.seed}__{int(time.time())}"
            fix = "log in with: wandb login, set WANDB_MODE=offline, or leave out --track"
            with explained("--track: Weights & Biases can't be used", fix=fix):
                self._run = wandb.init(
                    id=known,
                    resume="allow" if known else None,
                    name=None if known else name,
                    project=flags.wandb_project_name,
                    entity=flags.wandb_entity,
                    group=flags.wandb_group,
                    tags=flags.wandb_tags,
                    config={**flags.values(), "hyperparams": self.hyperparams},
                    sync_tensorboard=True,
                )
        if folder is not None and path is not None:
            path.write_text(self._run.id)
            self._run.config.update({"folder": str(folder.path)}, allow_val_change=True)

    def finish(self) -> None:
        """Let Weights & Biases have what it has not yet."""
        if self._run is None:
            return
        try:
            self._run.finish()
        except Exception as error:  # its client raises what it likes; the run is on disk
            print(
                f"--track: Weights & Biases did not get everything: {one_line(error)}; "
                "send it with: wandb sync",
                file=sys.stderr,
            )
        self._run = None
