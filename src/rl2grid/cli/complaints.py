"""What is wrong with a value, in words for people, of what two parsers say about it."""

from __future__ import annotations

import re

_WORDS = (
    (r"Error parsing hyperparameters: (.+)", r"\1"),
    (r"Error parsing (--\S+): invalid literal for int\(\) with base 10: (.+)", r"\1 takes a whole number, not \2"),
    (r"Error parsing (--\S+): could not convert string to float: (.+)", r"\1 takes a number, not \2"),
    (r"Error parsing (--\S+): no type matching {None}\|INT .+ from \[(.+?)\].*", r"\1 takes a whole number, not \2"),
    (r"Error parsing (--\S+): no type matching {None}\|FLOAT .+ from \[(.+?)\].*", r"\1 takes a number, not \2"),
    (r"Error parsing (--\S+): Could not find valid parse for arguments: \[(.+)\]", r"\1 does not take \2"),
    (r"argument (--\S+): invalid int value: (.+)", r"\1 takes a whole number, not \2"),
    (r"argument (--\S+): invalid float value: (.+)", r"\1 takes a number, not \2"),
)
"""Patterns of whole complaints, of tyro and of argparse, and what is said in their place."""


def in_words(complaint: str) -> str:
    """The complaint of a parser about a value, without words of Python; any other as it is."""
    for pattern, words in _WORDS:
        found = re.fullmatch(pattern, complaint, re.DOTALL)
        if found:
            return found.expand(words)
    return complaint
