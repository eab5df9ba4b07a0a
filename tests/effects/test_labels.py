"""Labels of effects of one kind. Truth: the labels of the list from which one has been taken."""

from types import SimpleNamespace

import pytest

from irlos_pipe.effects.base import kind_of, label_after, labels_of

KINDS = ["companion", "plate_scale", "companion", "companion", "tip_tilt_jitter", "companion"]


@pytest.mark.parametrize("gone", range(len(KINDS)))
def test_labels_after_one_has_left_are_those_of_the_others(gone):
    effects = [SimpleNamespace(name=name) for name in KINDS]
    labels = labels_of(effects)
    others = [label for position, label in enumerate(labels) if position != gone]
    left = [effect for position, effect in enumerate(effects) if position != gone]
    assert [label_after(label, labels[gone]) for label in others] == labels_of(left)


def test_every_label_tells_its_kind():
    assert [kind_of(label) for label in labels_of([SimpleNamespace(name=name) for name in KINDS])] == KINDS
