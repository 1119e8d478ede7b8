"""YAML as people write it: plain data, no key twice, and nothing that contains itself."""

from typing import Any

import yaml


class DoubleKeyError(yaml.YAMLError):
    """A mapping has a key twice, of which PyYAML would take the last without a word."""


class _Loader(yaml.SafeLoader):
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
