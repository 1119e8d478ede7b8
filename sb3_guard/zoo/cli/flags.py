"""The flags of a command, each stated once, as a field of a dataclass.

From the field come the parser, the default, the help, the typed attribute, the check of the same
value in a file, and whether it is part of what a run *is*::

    @dataclass
    class Flags(Command):
        \"\"\"
        Train an agent.

        What is trained:

        :param algo: algorithm
        :param n_timesteps: length
        \"\"\"

        algo: str = flag(default="cpo", role=IDENTITY)
        n_timesteps: int = flag("-n", default=-1, low=1, metavar="N")

    main = command(Flags, train)  # train(flags: Flags) -> exit status

The long name is the field's (``--n-timesteps``), headings and help are the docstring's; a flag that
has no line there is not shown. Annotations choose how a value is read, from the command line as
from a file: ``bool`` is a switch, ``list[int]`` takes several, ``dict`` takes ``key:value``,
``Literal`` one of its values.
"""

import argparse
import dataclasses
import inspect
import math
import re
import sys
import types
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal, NoReturn, Self

from sb3_guard.fields import did_you_mean, fit, nearest, parse_value
from sb3_guard.zoo.cli.usage import UsageError, run

# Roles of a flag: it says what a run is, how it is started, or how it is hosted and watched,
# which may change when the run is resumed.
IDENTITY, START, HOST = "identity", "start", "host"


def flag(
    *names: str,
    default: Any = None,
    role: str = START,
    low: float = -math.inf,
    high: float = math.inf,
    ends: str = "[)",
    exclusive: str | None = None,
    positional: bool = False,
    **argparse_options: Any,
) -> Any:
    """
    One flag of a command, as the default of a dataclass field.

    :param names: short names
    :param default: value where the flag is not given; a list or dictionary is copied
    :param role: ``IDENTITY``, ``START`` or ``HOST``
    :param low: least value of a number; also ``high``, and ``ends`` as for
        :func:`sb3_guard.fields.fit`
    :param exclusive: at most one flag of the same ``exclusive`` can be given
    :param positional: the value is given without the flag's name
    :param argparse_options: for ``add_argument``, e.g. ``metavar``
    """
    meta = {
        "names": names, "role": role, "range": (low, high, ends), "exclusive": exclusive,
        "positional": positional, "options": argparse_options,
    }  # fmt: skip
    if isinstance(default, list | dict):
        return dataclasses.field(default_factory=default.copy, metadata=meta)
    return dataclasses.field(default=default, metadata=meta)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Raise instead of printing the usage, which would bury the message."""
        raise UsageError(" ".join(message.split()))


@dataclasses.dataclass
class Command:
    """Flags and values of a command; subclasses are dataclasses whose docstring describes it."""

    prog: ClassVar[str] = "sb3-guard"
    examples: ClassVar[str] = ""

    def __post_init__(self) -> None:
        #: names of the flags that were given, on the command line or in a file
        self.given: frozenset[str] = frozenset()

    @classmethod
    def parser(cls) -> argparse.ArgumentParser:
        """The flags as a parser of text; what is not given is absent from its result."""
        result = _Parser(
            prog=cls.prog,
            description=inspect.cleandoc(cls.__doc__ or "").partition("\n\n")[0],
            epilog=cls.examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            argument_default=argparse.SUPPRESS,
            allow_abbrev=False,
        )
        groups: dict[str, Any] = {}
        said = cls._said()
        for field, hint in cls._flags():
            meta, kind = field.metadata, _kind(hint)
            heading, help_ = said.get(field.name, ("options", argparse.SUPPRESS))
            if heading not in groups:
                groups[heading] = result.add_argument_group(heading)
            group = groups[heading]
            if name := meta["exclusive"]:
                if name not in groups:
                    groups[name] = group.add_mutually_exclusive_group()
                group = groups[name]
            options: dict[str, Any] = {"help": help_}
            if kind is bool:
                options["action"] = "store_true"
            elif kind is dict:  # may be repeated; what comes later wins
                options |= {"nargs": "+", "action": "extend", "metavar": "KEY:VALUE"}
            elif kind is list:
                options["nargs"] = "+"
            elif kind is Literal:
                options["metavar"] = f"{{{','.join(map(str, typing.get_args(_bare(hint))))}}}"
            options |= meta["options"]
            if meta["positional"]:
                group.add_argument(field.name, **{"default": None, **options})
            else:
                names = [*meta["names"], _long(field.name)]
                group.add_argument(*names, dest=field.name, **options)
        return result

    @classmethod
    def parse(cls, argv: Sequence[str] | None = None) -> Self:
        """
        The values of a command line.

        :param argv: arguments; None: those of the process
        :raises UsageError: a flag is unknown, with the nearest name, or a value is not allowed
        """
        namespace, unknown = cls.parser().parse_known_args(argv)
        if unknown:
            word = unknown[0].split("=")[0]
            near = nearest(word, map(_long, cls.names()))
            remedy = f"did you mean {near}?" if near else "see --help"
            raise UsageError(f"unknown argument {word}; {remedy}")
        return cls.of(cls._read(vars(namespace)))

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Self:
        """The flags with some values given, typed already."""
        result = cls(**given)
        result.given = frozenset(given)
        return result

    @classmethod
    def read(cls, data: Mapping[str, Any], where: object, but: Sequence[str] = ()) -> Self:
        """
        The values of a file, checked as on the command line; data stays data.

        :param data: flags by name, in either spelling
        :param where: the file, for the message
        :param but: flags that a file can't give
        :raises UsageError: a name is unknown, or a value not allowed
        """
        names = cls.names() - {*but}
        content = {str(key).replace("-", "_"): value for key, value in data.items()}
        for name in content.keys() - names:
            hint = did_you_mean(name, sorted(names))
            raise UsageError(f"{where}: unknown entry {name!r}; {hint}")
        return cls.of(cls._read(content, where))

    @classmethod
    def _read(cls, data: Mapping[str, Any], where: object = None) -> dict[str, Any]:
        """The values that are given; those of a file that are defaults are not."""
        given = {}
        for field, hint in cls._flags():
            name, value = field.name, data.get(field.name)
            if where is not None:
                label, absent = f"{where}: {name}", value is None or value == _default(field)
            else:
                label = name if field.metadata["positional"] else _long(name)
                absent = value is None or value == []
            if not absent:
                try:
                    given[name] = _value(field, hint, value, label)
                except ValueError as error:
                    text = str(error)
                    raise UsageError(text if label in text else f"{label}: {text}") from None
        return given

    def values(self, *roles: str) -> dict[str, Any]:
        """The flags by name, of these roles only if any are named."""
        return {name: getattr(self, name) for name in sorted(self.names(*roles))}

    def words(self, names: Collection[str]) -> list[str]:
        """What :meth:`parse` reads as these flags; those that have their default are left out."""
        words = []
        for field, _ in self._flags():
            value, name = getattr(self, field.name), _long(field.name)
            if field.name not in names or value == _default(field):
                continue
            if isinstance(value, bool):
                words.append(name)
            elif isinstance(value, Mapping):
                words += [name, *(f"{key}:{item}" for key, item in value.items())]
            else:
                words += [name, *map(str, value if isinstance(value, list) else [value])]
        return words

    @classmethod
    def names(cls, *roles: str) -> set[str]:
        """Names of the flags, of these roles only if any are named."""
        return {f.name for f, _ in cls._flags() if not roles or f.metadata["role"] in roles}

    @classmethod
    def _said(cls) -> dict[str, tuple[str, str]]:
        """Heading and help of the flags, as the docstrings of the class and its bases have them."""
        texts = {}
        for base in reversed(cls.__mro__):
            heading = "options"
            for part in re.split(r"\n\s*\n|\n(?=\s*:param)", base.__doc__ or ""):
                text = " ".join(part.split())
                if flag := re.fullmatch(r":param (\w+): (.*)", text):
                    texts[flag[1]] = heading, flag[2].replace("%", "%%")
                elif text.endswith(":"):
                    heading = text[:-1].lower()
        return texts

    @classmethod
    def _flags(cls) -> Iterator[tuple[dataclasses.Field[Any], Any]]:
        hints = typing.get_type_hints(cls)
        for field in dataclasses.fields(cls):
            if "role" in field.metadata:
                yield field, hints[field.name]


def command(flags: type[Any], function: Callable[[Any], int]) -> Callable[..., int]:
    """
    The ``main`` of a command.

    :param flags: its :class:`Command`
    :param function: carries it out, returns the exit status, and raises :class:`UsageError`
    """

    def main(argv: Sequence[str] | None = None) -> int:
        """
        Run the command.

        :param argv: arguments; None: those of the process
        :return: exit status: 0, 2 for wrong usage, 130 or 128 + the signal's number if interrupted
        """
        return run(lambda: function(flags.parse(sys.argv[1:] if argv is None else argv)))

    return main


def _long(name: str) -> str:
    return "--" + name.replace("_", "-")


def _default(field: "dataclasses.Field[Any]") -> Any:
    made = field.default_factory
    return field.default if made is dataclasses.MISSING else made()


def _bare(hint: Any) -> Any:
    """An annotation without its ``| None``."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return next(arm for arm in typing.get_args(hint) if arm is not type(None))
    return hint


def _kind(hint: Any) -> Any:
    """The type of an annotation: ``list`` of ``list[int] | None``."""
    return typing.get_origin(_bare(hint)) or _bare(hint)


def _value(field: "dataclasses.Field[Any]", hint: Any, value: Any, label: str) -> Any:
    """A value of a command line or a file as the flag has it."""
    kind = _kind(hint)
    items = value if isinstance(value, list) else [value]
    if kind is dict and not isinstance(value, Mapping):
        pairs = [str(item).partition(":") for item in items]
        for key, colon, _ in pairs:
            if not (key and colon):
                raise ValueError(f"{label}: {key!r} is not of the form key:value")
        return {key: parse_value(text) for key, _, text in pairs}
    value = items if kind is list else value
    return fit(label, value, _bare(hint), *field.metadata["range"])
