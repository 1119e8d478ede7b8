"""One run of a grid: what it is, and how far it is."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.start import path_of


@dataclass(eq=False)
class Run:
    """
    One run of a grid.

    :param flags: all flags, as its folder states them
    :param values: all hyperparameters, in the same form
    :param ignored: those given for the grid that its algorithm does not have
    """

    flags: RunFlags
    values: dict[str, Any]
    ignored: list[str]
    #: at first done · resume · new; later waiting · running · in use · done · failed · stopped
    state: str
    #: what went wrong, in a line
    error: str = ""

    @property
    def path(self) -> Path:
        """Its folder."""
        return path_of(self.flags)

    @property
    def steps(self) -> int:
        """Its length, environment steps."""
        return int(self.values["n_timesteps"])

    def __str__(self) -> str:
        return f"{self.flags.algo} on {self.flags.env}, seed {self.flags.seed}"
