"""YAML as people write it: plain data, no key twice, and nothing that contains itself."""

from typing import Any

import yaml

LARGEST = 1_000_000  # values in a file, those that aliases repeat included
DEEPEST = 100  # values within values; PyYAML recurses, and in C that ends the process


class DoubleKeyError(yaml.YAMLError):
    """A mapping has a key twice, of which PyYAML would silently take the last."""


# In C where libyaml is there, ten times as fast: a large grid reads a thousand files.
class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self.deep_construct = True  # PyYAML then refuses an alias within what it stands for

    def get_single_node(self) -> Any:
        """
        The text's root.

        :raises yaml.YAMLError: a mapping has a key twice, or a few lines of nested aliases stand
            for more than a million values
        """
        root = super().get_single_node()
        sizes: dict[int, float] = {}

        def size(node: Any) -> float:
            if id(node) not in sizes:
                sizes[id(node)] = 0.0  # within itself
                below = node.value if isinstance(node, yaml.CollectionNode) else ()
                if isinstance(node, yaml.MappingNode):
                    _refuse_double_keys(node)
                    below = [one for pair in below for one in pair]
                sizes[id(node)] = 1.0 + sum(size(one) for one in below)
            return sizes[id(node)]

        if size(root) > LARGEST:
            raise yaml.YAMLError(f"its aliases stand for {size(root):.1g} values")
        return root


# The ordered mappings that RL-Zoo writes
_Loader.add_constructor(
    "tag:yaml.org,2002:python/object/apply:collections.OrderedDict",
    lambda loader, node: dict(loader.construct_sequence(node, deep=True)[0]),
)


def _refuse_double_keys(node: yaml.MappingNode) -> None:
    lines: dict[str, int] = {}
    for key, _ in node.value:
        # merges, "<<: *other", may be several
        if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
            line = key.start_mark.line + 1
            if key.value in lines:
                raise DoubleKeyError(
                    f"line {line} has the key {key.value!r} again, after line "
                    f"{lines[key.value]}: keep one of the two"
                )
            lines[key.value] = line


def load_yaml(text: str) -> Any:
    """The plain data of a YAML text.

    :raises yaml.YAMLError: it is no YAML, a mapping has a key twice, or something contains itself
        or is nested too deeply
    """
    depth = 0
    for event in yaml.parse(text, _Loader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise yaml.YAMLError(f"it is nested more than {DEEPEST} levels deep")
    return yaml.load(text, _Loader)
