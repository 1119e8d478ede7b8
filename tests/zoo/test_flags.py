"""Flags stated once: parser, defaults, files, roles and tables come from the same field."""

import argparse
from dataclasses import dataclass
from typing import Any, Literal

import pytest

from sb3_guard.zoo.cli.flags import HOST, IDENTITY, Command, flag
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.run.flags import RunFlags


@dataclass
class Toy(Command):
    """
    Play with flags.

    What there is:

    :param kind: size
    :param length: steps
    :param params: values
    :param seeds: seeds
    :param seed: a seed
    :param bar: a bar
    :param dry_run: nothing
    :param rate: factor, which
        may be 100 %
    """

    kind: Literal["big", "small"] = flag(default="big", positional=True, nargs="?")
    length: int = flag("-n", default=-1, low=1, metavar="N", role=IDENTITY)
    params: dict[str, Any] | None = flag("-params", role=IDENTITY)
    seeds: list[int] = flag(default=[0, 1], exclusive="seed")
    seed: int = flag(default=0, exclusive="seed")
    bar: bool = flag("-P", default=False, role=HOST)
    dry_run: bool = flag(default=False)
    rate: float = flag(default=1.0)
    secret: str | None = flag()


def test_typed_attributes_and_what_was_given():
    toy = Toy.parse(["small", "-n", "3e2", "-params", "a:1", "b:dict(c=[x])", "-P"])
    assert (toy.kind, toy.length, toy.params) == ("small", 300, {"a": 1, "b": "dict(c=[x])"})
    assert (toy.bar, toy.dry_run, toy.seeds, toy.rate) == (True, False, [0, 1], 1.0)
    assert toy.given == {"kind", "length", "params", "bar"}
    assert Toy.parse([]).given == frozenset()
    Toy.parse([]).seeds.append(2)
    assert Toy.parse([]).seeds == [0, 1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--lenght=3"], "unknown argument --lenght; did you mean --length"),
        (["big", "--zzz"], "unknown argument --zzz; see --help"),
        (["-n", "0"], "--length = '0' must be at least 1"),
        (["-n", "1.5"], "--length = '1.5' must be an integer, at least 1"),
        (["smal"], "kind = 'smal': did you mean 'small'"),
        (["-params", "a"], "--params: 'a' is not of the form key:value"),
        (["--seed", "1", "--seeds", "1"], "not allowed with argument --seed"),
        (["--rate", "fast"], "--rate = 'fast' must be a number"),
    ],
)
def test_what_is_not_allowed_on_the_command_line(arguments, message):
    with pytest.raises(UsageError, match=message):
        Toy.parse(arguments)


def test_a_files_values_are_checked_the_same_way():
    toy = Toy.read({"length": "3e2", "params": {"a": "1"}, "seeds": 5, "dry-run": True}, "x.yml")
    assert (toy.length, toy.params, toy.seeds, toy.dry_run) == (300, {"a": "1"}, [5], True)
    assert Toy.read({"params": ["a:1"], "kind": None}, "x.yml").params == {"a": 1}
    assert Toy.read({"length": -1}, "x.yml").length == -1  # a default may be no value to give
    assert toy.given == {"length", "params", "seeds", "dry_run"}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"lenght": 3}, "x.yml: unknown entry 'lenght'; did you mean 'length'"),
        ({"seed": 1}, "x.yml: unknown entry 'seed'"),
        ({"length": [3]}, "x.yml: length = .* must be an integer"),
        ({"seeds": [1, 2.5]}, "seeds = .* a list, each item an integer"),
        ({"dry_run": "yes"}, "dry_run = 'yes' must be true or false"),
        ({"params": 3}, "'3' is not of the form key:value"),
        ({"kind": "smal"}, "kind = 'smal': did you mean 'small'"),
    ],
)
def test_what_is_not_allowed_in_a_file(data, message):
    with pytest.raises(UsageError, match=message):
        Toy.read(data, "x.yml", but=["seed"])


def test_roles_and_help():
    toy = Toy.parse(["-n", "5"])
    assert toy.values(IDENTITY) == {"length": 5, "params": None}
    assert Toy.names(HOST) == {"bar"}
    text = Toy.parser().format_help()
    assert "secret" not in text and "factor, which may be 100 %" in text
    assert text.index("Play with flags.\n") < text.index("what there is:") < text.index("a bar")


def test_every_flag_of_rl_zoo_is_there():
    """Of those that RL-Zoo's `train` has and that mean something here, to the letter."""
    ours = RunFlags.parser()._option_string_actions
    for name in (
        "--algo --env -tb --tensorboard-log -i --trained-agent --eval-env-kwargs -n --n-timesteps "
        "--num-threads --log-interval --eval-freq --eval-episodes --n-eval-envs --save-freq -f "
        "--log-folder --seed --vec-env --device --verbose --gym-packages --env-kwargs -params "
        "--hyperparams -conf --conf-file -uuid --uuid --track --wandb-project-name --wandb-entity "
        "-P --progress -tags --wandb-tags"
    ).split():
        assert name in ours, name
        assert isinstance(ours[name], argparse.Action)


def test_a_runs_flags_from_those_another_command_shares():
    run = RunFlags.shared(Toy.parse(["--seed", "3"]), algo="pcpo")
    assert (run.seed, run.algo, run.eval_freq) == (3, "pcpo", 100_000)
