"""A run at Weights & Biases: its TensorBoard events are sent there as they are written."""

import time
from collections.abc import Mapping
from typing import Any

from sb3_guard.zoo.cli.usage import explained
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder

ID = "wandb.txt"  # beside the run's configuration: its id at Weights & Biases


def track(flags: RunFlags, hyperparams: Mapping[str, Any], folder: RunFolder | None) -> Any:
    """
    Begin the run at Weights & Biases, or continue it.

    Events of files that are open already would not be seen. Nothing is written here, so that a
    refusal leaves no folder behind.

    :param folder: the folder of a run that is resumed; None: a new run
    :return: wandb's run
    :raises UsageError: Weights & Biases refuses, e.g. for want of a key or a network
    """
    import wandb

    file = None if folder is None else folder.params / ID
    run_id = file.read_text().strip() if file is not None and file.exists() else None
    name = f"{flags.env}__{flags.algo}__{flags.seed}__{int(time.time())}"
    fix = "log in with: wandb login, set WANDB_MODE=offline, or leave out --track"
    with explained("--track: Weights & Biases can't be used", fix=fix):
        return wandb.init(
            id=run_id,
            resume=None if run_id is None else "allow",
            name=name if run_id is None else None,
            project=flags.wandb_project_name,
            entity=flags.wandb_entity,
            group=flags.wandb_group,
            tags=flags.wandb_tags,
            config={**flags.values(), "hyperparams": hyperparams},
            sync_tensorboard=True,
        )
