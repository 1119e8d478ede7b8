"""YAML as people write it: plain data."""

from typing import Any

import yaml


# In C where libyaml is there, ten times as fast: a large grid reads a thousand files.
class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    pass


def _ordered(loader: Any, node: Any) -> dict[Any, Any]:
    """The ordered mapping that RL-Zoo writes: a list of one list of pairs."""
    return dict(*loader.construct_sequence(node, deep=True))


_Loader.add_constructor("tag:yaml.org,2002:python/object/apply:collections.OrderedDict", _ordered)


def load_yaml(text: str) -> Any:
    """
    The plain data of a YAML text.

    :raises yaml.YAMLError: it is no YAML
    """
    return yaml.load(text, _Loader)
