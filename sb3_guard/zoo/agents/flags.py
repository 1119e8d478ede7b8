"""The flags of the commands that take a trained agent: ``enjoy``, ``certify`` and ``export``."""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from sb3_guard.zoo.cli.flags import Command, flag


@dataclass
class AgentFlags(Command):
    """
    Which agent, and how it acts.

    Which agent:

    :param algo: algorithm (default: the only one that has a run of --env, else cpo)
    :param env: environment id (default: Goal_Point_8Hazards)
    :param folder: log folder, or the folder of a run, without --algo and --env (default: logs)
    :param exp_id: number of the run; 0: the latest, -1: <folder>/<algo> itself is the run (default:
        0)
    :param load_best: take the best checkpoint (highest return among those within the limit) instead
        of the certified or last one
    :param load_final: take the final model, also where another one is certified
    :param pretrained: take the agent that comes with the package for --env; enjoy without --env
        lists them
    :param load_checkpoint: take the model that was kept after this number of steps
    :param load_last_checkpoint: take the last model that was kept

    What is played:

    :param n_episodes: number of episodes (default: 100; 5 in a window, 1 to record)
    :param stochastic: sample actions; else the most likely ones are taken, but for an agent that is
        certified with sampled ones
    :param deterministic: take the most likely actions in any case
    :param seed: random seed of the episodes (default: 0)
    :param env_kwargs: arguments of the environment, which replace those of training
    :param gym_packages: modules to import first, such as those that training imported

    Output:

    :param device: torch device (default: auto)
    :param num_threads: threads of torch; -1: chosen by torch (default: -1)
    """

    algo: str = flag(default="cpo")
    env: str = flag(default="Goal_Point_8Hazards-v0")
    folder: str = flag("-f", default="logs", metavar="DIR")
    exp_id: int = flag(default=0, metavar="K")
    load_best: bool = flag(default=False, exclusive="model")
    load_final: bool = flag(default=False, exclusive="model")
    pretrained: bool = flag(default=False, exclusive="model")
    load_checkpoint: int | None = flag(low=1, metavar="STEPS", exclusive="model")
    load_last_checkpoint: bool = flag(default=False, exclusive="model")
    n_episodes: int | None = flag(low=1, metavar="N", exclusive="length")
    stochastic: bool = flag(default=False, exclusive="actions")
    deterministic: bool = flag(default=False, exclusive="actions")
    seed: int = flag(default=0, low=0, high=2**32)
    env_kwargs: dict[str, Any] | None = flag()
    gym_packages: list[str] = flag(default=[], metavar="MODULE")
    device: str = flag(default="auto")
    num_threads: int = flag(default=-1, metavar="N")


@dataclass
class EnjoyFlags(AgentFlags):
    """
    Play a trained agent and print return and cost of each episode.

    What is played:

    :param n_timesteps: number of steps to play, instead of --n-episodes

    Output:

    :param record: write a video with return, cost and limit in the frame; needs no display (default
        file: next to the model, for a pretrained agent in the current folder)
    :param dataset: write the episodes as a dataset of Minari's with this name (point/cpo-v0), or to
        this file in DSRL's layout (cpo.hdf5); needs the extra sb3-guard[datasets]
    :param window: open MuJoCo's viewer (default where there is a display): Space pauses, Tab opens
        menus, F shows contact forces
    :param no_render: open no window
    :param verbose: output: 0 means only, 1 every episode (default: 1)
    """

    prog: ClassVar[str] = "sb3-guard enjoy"
    examples: ClassVar[str] = """examples:
  sb3-guard enjoy --pretrained                   # lists them
  sb3-guard enjoy --algo cpo --env Goal_Point_8Hazards -f logs
  sb3-guard enjoy --algo cpo --env Goal_Point_8Hazards --load-best --n-episodes 20
  sb3-guard enjoy --pretrained --env Goal_Point_8Hazards --record agent.mp4
  sb3-guard enjoy --pretrained --env Goal_Point_8Hazards --dataset point/usl-v0
"""
    n_timesteps: int | None = flag("-n", low=1, metavar="N", exclusive="length")
    record: str | None = flag(nargs="?", const="", metavar="FILE.mp4")
    dataset: str | None = flag(metavar="NAME")
    window: bool = flag(default=False, exclusive="window")
    no_render: bool = flag(default=False, exclusive="window")
    verbose: Literal[0, 1] = flag(default=1)


@dataclass
class CertifyFlags(AgentFlags):
    """
    Say whether a trained agent's mean episode cost is within its limit, by fresh episodes.

    After 600 episodes an upper 95 % confidence bound of the mean is compared with the limit; where
    more would decide, up to four times as many are played. The status is 0 if the agent is
    certified, else 1.

    What is played:

    :param n_episodes: episodes after which the agent may be certified, at least 100 (default: 600)
    :param cost_limit: limit of an episode's cost, or one for each cost (default: the agent's own)
    :param most: highest possible cost of an episode: the bounds are exact, and need some
        3 most / (limit - mean) episodes
    :param exact: the same with the highest cost that the environment states

    Output:

    :param json: write the certificate to this JSON file
    """

    prog: ClassVar[str] = "sb3-guard certify"
    examples: ClassVar[str] = """examples:
  sb3-guard certify --pretrained
  sb3-guard certify --algo cpo --env Goal_Point_8Hazards -f logs --load-final
  sb3-guard certify --algo ppo --env Goal_Point_8Hazards -f logs --cost-limit 5
"""
    n_episodes: int | None = flag(low=1, metavar="N")
    cost_limit: list[float] = flag(default=[], metavar="D")
    most: float | None = flag(low=0, metavar="B", exclusive="most")
    exact: bool = flag(default=False, exclusive="most")
    json: str | None = flag(metavar="FILE")


@dataclass
class ExportFlags(AgentFlags):
    """
    Write a trained agent as one ONNX file, which runs without torch and without this package.

    The file has the observation's normalisation, the policy, squashing or clipping, and the safety
    filter; contract.json next to it describes input and output. Sampled actions take their
    random numbers as an input.

    What is played:

    :param n_episodes: number of episodes whose return and cost the contract states (default: 100)

    Output:

    :param output: the file (default: policy.onnx)
    :param stop: what stops an actuator, in units of its control, or hold for its last control
        (default: the robot's keyframe stop, else hold for position servos and 0 for others)
    """

    prog: ClassVar[str] = "sb3-guard export"
    examples: ClassVar[str] = """examples:
  sb3-guard export --pretrained
  sb3-guard export --algo cpo --env Goal_Point_8Hazards -f logs -o robot/policy.onnx
"""
    output: str = flag("-o", default="policy.onnx", metavar="FILE.onnx")
    stop: dict[str, Any] | None = flag(metavar="ACTUATOR:VALUE")
