"""The flags of the commands that take a trained agent: ``enjoy`` and ``hub``."""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from sb3_guard.zoo.flags import Command, flag
from sb3_guard.zoo.run_flags import TRUST
from sb3_guard.zoo.usage import UsageError, positive, seed_number

WHICH, PLAYED, OUTPUT, PUSH = "which agent", "what is played", "output", "push"


@dataclass
class AgentFlags(Command):
    """Which agent, and how it acts."""

    algo: str = flag(default="cpo", group=WHICH, help="algorithm (default: cpo)")
    env: str = flag(
        default="Goal_Point_8Hazards-v0", group=WHICH,
        help="environment id (default: Goal_Point_8Hazards)",
    )  # fmt: skip
    folder: str = flag(
        "-f", default="logs", metavar="DIR", group=WHICH, help="log folder (default: logs)"
    )
    exp_id: int = flag(
        default=0, metavar="K", group=WHICH,
        help="number of the run; 0: the latest, -1: the folder itself (default: 0)",
    )  # fmt: skip
    load_best: bool = flag(
        default=False, group=WHICH, exclusive="model", help="the best model, safe first"
    )
    pretrained: bool = flag(
        default=False, group=WHICH, exclusive="model", help="an agent that comes with the package"
    )
    load_checkpoint: int | None = flag(
        kind=positive, metavar="STEPS", group=WHICH, exclusive="model",
        help="the model kept at so many steps",
    )  # fmt: skip
    load_last_checkpoint: bool = flag(
        default=False, group=WHICH, exclusive="model", help="the last model that was kept"
    )
    n_episodes: int | None = flag(
        kind=positive, metavar="N", group=PLAYED, exclusive="length",
        help="episodes (default: 5, or 1 to record; 10 for the hub)",
    )  # fmt: skip
    stochastic: bool = flag(
        default=False, group=PLAYED, exclusive="actions", help="sampled actions"
    )
    seed: int = flag(
        default=0, kind=seed_number, group=PLAYED, help="seed of the episodes (default: 0)"
    )
    env_kwargs: dict[str, Any] | None = flag(
        group=PLAYED, help="arguments of the environment, over those of training"
    )
    gym_packages: list[str] = flag(
        default=[], metavar="MODULE", group=PLAYED,
        help="modules to import first (default: those of training)",
    )  # fmt: skip
    trust: bool = flag(default=False, group=PLAYED, help=TRUST)
    device: str = flag(default="auto", group=OUTPUT, help="torch device (default: auto)")
    num_threads: int = flag(default=-1, metavar="N", group=OUTPUT, help="threads of torch")


@dataclass
class EnjoyFlags(AgentFlags):
    """Play a trained agent and print return and cost of each episode."""

    prog: ClassVar[str] = "sb3-guard enjoy"
    examples: ClassVar[str] = """examples:
  python -m sb3_guard.enjoy --pretrained
  python -m sb3_guard.enjoy --algo cpo --env Goal_Point_8Hazards -f logs
  python -m sb3_guard.enjoy --algo cpo --env Goal_Point_8Hazards --load-best --n-episodes 20
  python -m sb3_guard.enjoy --algo cpo --env Goal_Point_8Hazards --pretrained --record agent.mp4
"""
    n_timesteps: int | None = flag(
        "-n", kind=positive, metavar="N", group=PLAYED, exclusive="length", help="steps instead"
    )
    deterministic: bool = flag(
        default=False, group=PLAYED, exclusive="actions",
        help="the most likely actions (the default)",
    )  # fmt: skip
    record: str | None = flag(
        nargs="?", const="", metavar="FILE.mp4", group=OUTPUT,
        help="write a video; no display is needed (default: beside the model; of a pretrained "
        "agent in the current folder)",
    )  # fmt: skip
    json: str | None = flag(metavar="FILE", group=OUTPUT, help="write the statistics there as JSON")
    window: bool = flag(
        default=False, group=OUTPUT, exclusive="window",
        help="MuJoCo's viewer, the default where there is a display: Space pauses, Tab opens "
        "menus, F shows contact forces",
    )  # fmt: skip
    no_render: bool = flag(default=False, group=OUTPUT, exclusive="window", help="open no window")
    verbose: Literal[0, 1] = flag(default=1, group=OUTPUT, help="0: the means only")


@dataclass
class HubFlags(AgentFlags):
    """
    Upload a trained agent to the Hugging Face hub, or download one. Downloaded agents are programs:
    load only from people you trust.
    """

    prog: ClassVar[str] = "sb3-guard hub"
    examples: ClassVar[str] = """examples:
  sb3-guard hub push --algo cpo --env Goal_Point_8Hazards -f logs -orga me
  sb3-guard hub push --algo cpo --env Goal_Point_8Hazards -orga me --dry-run --to card
  sb3-guard hub load --algo cpo --env Goal_Point_8Hazards -orga me -f logs
"""
    direction: Literal["push", "load"] = flag(
        positional=True, group=WHICH, help="upload or download"
    )
    organization: str | None = flag(
        "-orga", metavar="NAME", group=WHICH, help="user or organization"
    )
    repo_name: str | None = flag(
        "-name", metavar="NAME", group=WHICH, help="repository (default: <algo>-<env>)"
    )
    repo_id: str | None = flag(metavar="USER/NAME", group=WHICH, help="both in one")
    commit_message: str = flag(
        "-m", default="Upload a trained agent", metavar="TEXT", group=PUSH, help="of the upload"
    )
    private: bool = flag(default=False, group=PUSH, help="make the repository private")
    no_video: bool = flag(default=False, group=PUSH, help="do not film an episode")
    dry_run: bool = flag(default=False, group=PUSH, help="write all files, upload nothing")
    to: str | None = flag(metavar="DIR", group=PUSH, help="where the files are written first")

    def check(self) -> None:
        """
        Take ``--repo-id`` apart.

        :raises UsageError: nothing says whose repository, or not in the right form
        """
        if self.repo_id is not None:
            organization, slash, name = self.repo_id.partition("/")
            if not (organization and slash and name) or "/" in name:
                raise UsageError(f"--repo-id {self.repo_id!r} must be of the form user/name")
            self.organization, self.repo_name = organization, name
        elif self.organization is None:
            raise UsageError("whose repository? give -orga NAME, or --repo-id user/name")
