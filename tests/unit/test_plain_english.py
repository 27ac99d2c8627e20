"""The check of plain English finds turns of phrase, by place, in docstrings and comments."""

from __future__ import annotations

from tests.support.plain_english import texts, too_often


def test_docstrings_and_comments_are_looked_at() -> None:
    source = '"""Module."""\n\n\ndef one() -> None:\n    """Function."""\n    x = "# no comment"  # a comment\n'
    assert sorted(texts(source)) == [(1, "Module."), (5, "Function."), (6, "a comment")]


def test_a_figure_above_its_limit_is_named_with_its_places() -> None:
    plain = [("a.py:1", "Return the lowest verdict that this finding allows. " * 200)]
    assert too_often(plain) == []
    complaints = too_often([*plain, ("b.py:7", "What it makes the verdict at least."), ("c.py:2", "What is left.")])
    assert complaints[0].startswith(r"\bwhat\b: 2 in 1610 words")
    assert complaints[1:] == ["b.py:7", "c.py:2"]
