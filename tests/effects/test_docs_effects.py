"""The page of the documentation that lists all effects is that of the classes."""

from __future__ import annotations

from helpers.paths import REPOSITORY

from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.catalogue import catalogue_page

MAKE = "python -c 'from irlos_pipe.effects.catalogue import catalogue_page as p; print(p(), end=\"\")'"


def test_the_page_lists_what_the_classes_declare():
    page = (REPOSITORY / "docs" / "effects.md").read_text()
    assert page == catalogue_page(), f"write it again: {MAKE} > docs/effects.md"


def test_every_effect_says_what_it_is_mistaken_for_and_where_it_is_described():
    for kind in CATALOGUE.values():
        assert kind.look_alike, kind.name
        assert kind.reference and kind.formula, kind.name
        assert all(public.unit or public.lower > -1e9 for public in kind.public), kind.name
