"""Every equation of the paper has a place in the code, and the page that lists them finds it."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

from tests.docs.blocks import ROOT

sys.path.insert(0, str(ROOT / "docs" / "_ext"))

equations: Any = import_module("equations")

NUMBERS = range(1, 58)


def test_the_page_names_each_equation_once() -> None:
    assert [number for section in equations.SECTIONS.values() for number in section] == list(NUMBERS)


def test_each_equation_has_a_place_of_its_own() -> None:
    found = equations.places(equations.CODE)
    missing = [n for n in NUMBERS if not any(place.width <= equations.WIDEST for place in found.get(n, []))]
    assert missing == []
    assert set(found) == set(NUMBERS)  # a citation of another number is a slip


def test_each_equation_is_cited_by_a_test() -> None:
    assert set(NUMBERS) <= set(equations.places(equations.TESTS))


def test_a_citation_is_read_with_its_ranges_and_remarks() -> None:
    lines = (
        '"""Eqs 6-8."""',
        "class A:",
        "    def f(self):",
        "        # Eqs 9, 12 (U 4) and 10,",
        "        # 13 (W 4).",
        "        pass",
    )
    source = "\n".join(lines)
    found = [(number, place.name, place.width) for number, place in equations.cited(source, "x.py")]
    assert found == [(6, "", 2), (7, "", 2), (8, "", 2), (9, "A.f", 0), (12, "A.f", 0), (10, "A.f", 0), (13, "A.f", 0)]
