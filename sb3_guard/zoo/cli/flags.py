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
        n_timesteps: int = flag("-n", default=-1, kind=positive, metavar="N")

    main = command(Flags, train)  # train(flags: Flags) -> exit status

The long name is the field's (``--n-timesteps``), headings and help are the docstring's; a flag that
has no line there is not shown. Annotations choose how a value is read: ``bool``
is a switch, ``bool | None`` has a ``--no-…``, ``list[int]`` takes several, ``dict`` takes
``key:value``, ``Literal`` one of its values.
"""

import argparse
import dataclasses
import inspect
import re
import sys
import types
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

from sb3_guard.fields import in_words, typed
from sb3_guard.spelling import did_you_mean, nearest
from sb3_guard.zoo.cli.usage import Parser, UsageError, key_value, run

# Roles of a flag: it says what a run is, how it is started, or how it is hosted and watched,
# which may change when the run is resumed.
IDENTITY, START, HOST = "identity", "start", "host"


def flag(
    *names: str,
    default: Any = None,
    role: str = START,
    kind: Callable[[Any], Any] | None = None,
    exclusive: str | None = None,
    positional: bool = False,
    **argparse_options: Any,
) -> Any:
    """
    One flag of a command, as the default of a dataclass field.

    :param names: short names
    :param default: value where the flag is not given; a list or dictionary is copied
    :param role: ``IDENTITY``, ``START`` or ``HOST``
    :param kind: makes the value of its text or number, and raises ``ArgumentTypeError``
    :param exclusive: at most one flag of the same ``exclusive`` can be given
    :param positional: the value is given without the flag's name
    :param argparse_options: for ``add_argument``, e.g. ``metavar``
    """
    meta = {
        "names": names, "role": role, "kind": kind, "exclusive": exclusive,
        "positional": positional, "options": argparse_options,
    }  # fmt: skip
    if isinstance(default, list | dict):
        copied = default
        return dataclasses.field(default_factory=lambda: copied.copy(), metadata=meta)
    return dataclasses.field(default=default, metadata=meta)


@dataclasses.dataclass
class Command:
    """Flags and values of a command; subclasses are dataclasses whose docstring describes it."""

    prog: ClassVar[str] = "sb3-guard"
    examples: ClassVar[str] = ""

    def __post_init__(self) -> None:
        #: names of the flags that were given, on the command line or in a file
        self.given: frozenset[str] = frozenset()

    @classmethod
    def parser(cls) -> Parser:
        """The flags as a parser; what is not given is absent from its result."""
        result = Parser(
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
            meta = field.metadata
            heading, help_ = said.get(field.name, ("options", argparse.SUPPRESS))
            group = groups.get(heading)
            if group is None:
                group = groups[heading] = result.add_argument_group(heading)
            if meta["exclusive"]:
                name = meta["exclusive"]
                if name not in groups:
                    groups[name] = group.add_mutually_exclusive_group()
                group = groups[name]
            options = {"help": help_, **_options(field, hint)}
            if meta["positional"]:
                group.add_argument(field.name, **{"default": None, **options})
            else:
                group.add_argument(*_names(field), dest=field.name, **options)
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
            flags = (field.name for field, _ in cls._flags() if not field.metadata["positional"])
            near = nearest(word, map(_long, flags))
            remedy = f"did you mean {near}?" if near else "see --help"
            raise UsageError(f"unknown argument {word}; {remedy}")
        parsed, given = vars(namespace), {}
        for field, hint in cls._flags():
            # What is absent is not there at all, except values that go without a flag.
            bare = field.metadata["positional"]
            if field.name in parsed and not (bare and parsed[field.name] in (None, [])):
                value = parsed[field.name]
                given[field.name] = dict(value) if _is(hint, dict) else value
        return cls.of(given)

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
        flags = {field.name: (field, hint) for field, hint in cls._flags() if field.name not in but}
        given = {}
        for key, value in data.items():
            name = str(key).replace("-", "_")
            if name not in flags:
                raise UsageError(f"{where}: unknown entry {key!r}; {did_you_mean(name, flags)}")
            field, hint = flags[name]
            if value is not None and value != _default(field):
                try:
                    value = _typed(hint, field.metadata["kind"], value)
                except (ValueError, TypeError, argparse.ArgumentTypeError) as error:
                    raise UsageError(
                        f"{where}: {key}: {value!r} is not allowed; it must be {_words(hint)}"
                        + (f" ({error})" if isinstance(error, argparse.ArgumentTypeError) else "")
                    ) from None
                given[name] = value
        return cls.of(given)

    def values(self, *roles: str) -> dict[str, Any]:
        """The flags by name, of these roles only if any are named."""
        return {name: getattr(self, name) for name in sorted(self.names(*roles))}

    def words(self, names: Collection[str]) -> list[str]:
        """What :meth:`parse` reads as these flags; those that have their default are left out."""
        words = []
        for field, _ in self._flags():
            value, name = getattr(self, field.name), _names(field)[-1]
            if field.name not in names or value == _default(field):
                continue
            if isinstance(value, bool):
                words.append(name if value else name.replace("--", "--no-", 1))
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


def _names(field: "dataclasses.Field[Any]") -> list[str]:
    return [*field.metadata["names"], _long(field.name)]


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


def _is(hint: Any, kind: type) -> bool:
    """Whether an annotation is a list or a dictionary, of whatever it holds."""
    return (typing.get_origin(_bare(hint)) or _bare(hint)) is kind


def _options(field: "dataclasses.Field[Any]", hint: Any) -> dict[str, Any]:
    """What argparse needs to know of a flag."""
    meta, bare = field.metadata, _bare(hint)
    arguments = typing.get_args(bare)
    options: dict[str, Any] = {}
    if bare is bool:
        options["action"] = "store_true" if bare is hint else argparse.BooleanOptionalAction
    elif _is(hint, dict):
        # The flag may be repeated; what comes later wins.
        options |= {"nargs": "+", "action": "extend", "type": key_value, "metavar": "KEY:VALUE"}
    elif _is(hint, list):
        options |= {"nargs": "+", "type": meta["kind"] or arguments[0]}
    elif typing.get_origin(bare) is Literal:
        options |= {"choices": list(arguments), "type": type(arguments[0])}
    else:
        options["type"] = meta["kind"] or bare
    return options | meta["options"]


def _typed(hint: Any, kind: Callable[[Any], Any] | None, value: Any) -> Any:
    """A value of a file as the flag has it."""
    items = value if isinstance(value, list) else [value]
    if _is(hint, dict):
        return dict(value) if isinstance(value, Mapping) else dict(map(key_value, items))
    if _is(hint, list):
        if not items:
            raise TypeError
        made = typed(items, _bare(hint))
        return [*map(kind, made)] if kind else made
    made = typed(value, _bare(hint))
    return kind(made) if kind else made


def _words(hint: Any) -> str:
    if _is(hint, dict):
        return "a mapping or a list of key:value"
    return "one value or a list of them" if _is(hint, list) else in_words(_bare(hint))
