"""Docstrings for the API pages (griffe): examples in code blocks, and < as a character."""

import re
from typing import Any

import griffe

EXAMPLE = re.compile(r"^>>> .*?(?=\n[ \t]*\n|\Z)", re.MULTILINE | re.DOTALL)
CODE_OR_LESS = re.compile(r"(`+)(?:.+?)\1|<", re.DOTALL)


class Examples(griffe.Extension):
    """Make each example of a docstring a block of code."""

    def on_object(self, *, obj: griffe.Object, **options: Any) -> None:
        """Change the docstring of an object once it is read."""
        if obj.docstring:
            obj.docstring.value = as_markdown(obj.docstring.value)


def as_markdown(docstring: str) -> str:
    """Return a docstring whose examples are fenced, and in which < begins no HTML elsewhere."""
    parts = []
    end = 0
    for example in EXAMPLE.finditer(docstring):
        parts += [escaped(docstring[end : example.start()]), f"```pycon\n{example[0]}\n```"]
        end = example.end()
    return "".join([*parts, escaped(docstring[end:])])


def escaped(text: str) -> str:
    text = re.sub(r"::\n", ":\n", text)
    return CODE_OR_LESS.sub(lambda match: "&lt;" if match[0] == "<" else match[0], text)
