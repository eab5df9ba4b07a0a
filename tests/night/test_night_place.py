"""Old products can be read until the new ones take their place, whenever the process is killed."""

import os
import shutil

import pytest

from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.night.place import Place
from irlos_pipe.product.runfolder import owned_folder


def work(place: Place, content: str) -> None:
    """Make products as a run does: each in a new file; the log grows."""
    with owned_folder(place.prepare()) as run:
        for name in ("a.h5", "b.h5"):
            fresh = run.path / f".{name}"
            fresh.write_text(content)
            os.replace(fresh, run.path / name)
        with open(run.log, "a") as log:
            log.write(content)


def shown(place: Place) -> list[str]:
    return [(place.path / name).read_text() for name in ("a.h5", "b.h5", "run.log")]


@pytest.fixture
def place(tmp_path) -> Place:
    place = Place(tmp_path / "night" / "cube")
    work(place, "old")
    place.publish()
    return place


def test_new_products_are_seen_when_they_are_published_and_not_before(place):
    work(place, "new")
    assert shown(place) == ["old", "old", "old"]
    place.publish()
    assert shown(place) == ["new", "new", "oldnew"]


def test_work_begins_with_the_published_products_without_copying_them(place):
    begun = place.prepare()
    assert os.path.samefile(begun / "a.h5", place.path / "a.h5")
    assert not os.path.samefile(begun / "run.log", place.path / "run.log")
    assert not (begun / ".lock").exists()


def test_what_was_begun_is_gone_on_with(place):
    (place.prepare() / "c.h5").touch()
    assert (place.prepare() / "c.h5").is_file()


def test_a_kill_while_the_products_are_taken_over_is_not_gone_on_with(place, monkeypatch):
    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            place.prepare()
    assert not place.workplace.exists()
    assert sorted(path.name for path in place.prepare().iterdir()) == ["a.h5", "b.h5", "run.log"]


@pytest.mark.parametrize(("module", "name"), [(os, "replace"), (os, "rename"), (shutil, "rmtree")])
def test_a_kill_while_publishing_leaves_one_whole_set(place, monkeypatch, module, name):
    work(place, "new")

    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module, name, killed)
        with pytest.raises(KeyboardInterrupt):
            place.publish()
    assert len(set(shown(place)[:2])) == 1
    work(place, "newest")
    place.publish()
    place.discard()
    assert shown(place)[:2] == ["newest", "newest"]
    assert sorted(path.name for path in place.path.parent.iterdir()) == [os.readlink(place.path), "cube"]


def test_something_else_under_that_name_is_not_replaced(tmp_path):
    (tmp_path / "cube").mkdir()
    with pytest.raises(IrlosError, match="is in the way"):
        Place(tmp_path / "cube").prepare()
