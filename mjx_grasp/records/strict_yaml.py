"""YAML in which no key stands twice: the plain loader keeps the last one and says nothing."""

from __future__ import annotations

from typing import Any

import yaml

_MERGE = "tag:yaml.org,2002:merge"
"""The key ``<<``: what else stands in the mapping takes precedence over what it names."""


class _Strict(yaml.SafeLoader):
    def compose_mapping_node(self, anchor: str | None) -> yaml.MappingNode:
        """The mapping as it is written: what ``<<`` names is filled in later."""
        node: yaml.MappingNode = super().compose_mapping_node(anchor)
        seen: list[Any] = []
        for key, _ in node.value:
            value = "<<" if key.tag == _MERGE else self.construct_object(key, deep=True)
            if value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"{value!r} stands twice", key.start_mark
                )
            seen.append(value)
        return node


def load_yaml(text: str) -> Any:
    """What a YAML text holds.

    Raises:
        yaml.YAMLError: It is none, or a key of a mapping stands twice.
    """
    return yaml.load(text, _Strict)
