"""YAML as people write it: plain data, and no key twice."""

from typing import Any

import yaml


# In C where libyaml is there, ten times as fast: a large grid reads a thousand files.
class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    def get_single_node(self) -> Any:
        """The text's root. Constructing it writes merges, ``<<: *other``, into its mappings."""
        root = super().get_single_node()
        nodes, seen = [root], set()
        while nodes:
            node = nodes.pop()
            if id(node) in seen or not isinstance(node, yaml.CollectionNode):
                continue
            seen.add(id(node))
            if isinstance(node, yaml.MappingNode):
                _refuse_double_keys(node)
                nodes += [item for pair in node.value for item in pair]
            else:
                nodes += node.value
        return root


def _refuse_double_keys(node: yaml.MappingNode) -> None:
    lines: dict[str, int] = {}
    for key, _ in node.value:
        # merges, "<<: *other", may be several
        if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
            line = key.start_mark.line + 1
            if key.value in lines:
                # PyYAML would silently take the last.
                raise yaml.YAMLError(
                    f"line {line} has the key {key.value!r} again, after line "
                    f"{lines[key.value]}: keep one of the two"
                )
            lines[key.value] = line


def _ordered(loader: Any, node: Any) -> dict[Any, Any]:
    """The ordered mapping that RL-Zoo writes: a list of one list of pairs."""
    return dict(*loader.construct_sequence(node, deep=True))


_Loader.add_constructor("tag:yaml.org,2002:python/object/apply:collections.OrderedDict", _ordered)


def load_yaml(text: str) -> Any:
    """
    The plain data of a YAML text.

    :raises yaml.YAMLError: it is no YAML, or a mapping has a key twice
    """
    return yaml.load(text, _Loader)
