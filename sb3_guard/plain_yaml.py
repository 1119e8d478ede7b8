"""YAML as people write it: plain data, no key twice, and nothing that contains itself."""

from typing import Any

import yaml


class DoubleKeyError(yaml.YAMLError):
    """A mapping has a key twice, of which PyYAML would take the last without a word."""


LARGEST = 1_000_000  # values in a file, those that aliases repeat included


class Bounded:
    """Mixed in before a loader: a few lines of nested aliases can't stand for a billion values."""

    def get_single_node(self) -> Any:
        """
        The text's root.

        :raises yaml.YAMLError: it stands for more than a million values
        """
        root = super().get_single_node()  # type: ignore[misc]
        sizes: dict[int, float] = {}

        def size(node: Any) -> float:
            if id(node) not in sizes:
                sizes[id(node)] = 0.0  # within itself
                below = node.value if isinstance(node, yaml.CollectionNode) else ()
                mapping = isinstance(node, yaml.MappingNode)
                flat = [one for pair in below for one in pair] if mapping else below
                sizes[id(node)] = 1.0 + sum(size(one) for one in flat)
            return sizes[id(node)]

        if size(root) > LARGEST:
            raise yaml.YAMLError(f"its aliases stand for {size(root):.1g} values")
        return root


class _Loader(Bounded, yaml.SafeLoader):
    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self.deep_construct = True  # PyYAML then refuses an alias within what it stands for

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
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
        return node


def load_yaml(text: str) -> Any:
    """The plain data of a YAML text.

    :raises yaml.YAMLError: it is no YAML, a mapping has a key twice, or something contains itself
    """
    return yaml.load(text, _Loader)
