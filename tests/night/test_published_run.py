"""Old products can be read until the new ones take their place, whenever the process is killed."""

import os
import shutil

import pytest

from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.night.published_run import PublishedRun
from irlos_pipe.product.runfolder import owned_folder


def work(run: PublishedRun, content: str) -> None:
    """Make products as a run does: each in a new file; the log grows."""
    with owned_folder(run.prepare()) as folder:
        for name in ("a.h5", "b.h5"):
            fresh = folder.path / f".{name}"
            fresh.write_text(content)
            os.replace(fresh, folder.path / name)
        with open(folder.log, "a") as log:
            log.write(content)


def shown(run: PublishedRun) -> list[str]:
    return [(run.path / name).read_text() for name in ("a.h5", "b.h5", "run.log")]


@pytest.fixture
def run(tmp_path) -> PublishedRun:
    run = PublishedRun(tmp_path / "night" / "cube")
    work(run, "old")
    run.publish()
    return run


def test_new_products_are_visible_when_they_are_published_and_not_before(run):
    work(run, "new")
    assert shown(run) == ["old", "old", "old"]
    run.publish()
    assert shown(run) == ["new", "new", "oldnew"]


def test_work_starts_with_hard_links_to_the_published_products(run):
    begun = run.prepare()
    assert os.path.samefile(begun / "a.h5", run.path / "a.h5")
    assert not os.path.samefile(begun / "run.log", run.path / "run.log")
    assert not (begun / ".lock").exists()


def test_unfinished_work_is_continued(run):
    (run.prepare() / "c.h5").touch()
    assert (run.prepare() / "c.h5").is_file()


def test_a_half_filled_work_folder_of_a_killed_run_is_not_continued(run, monkeypatch):
    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            run.prepare()
    assert not run.work_folder.exists()
    assert sorted(path.name for path in run.prepare().iterdir()) == ["a.h5", "b.h5", "run.log"]


@pytest.mark.parametrize(("module", "name"), [(os, "replace"), (os, "rename"), (shutil, "rmtree")])
def test_a_kill_while_publishing_leaves_one_complete_set(run, monkeypatch, module, name):
    work(run, "new")

    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module, name, killed)
        with pytest.raises(KeyboardInterrupt):
            run.publish()
    assert len(set(shown(run)[:2])) == 1
    work(run, "newest")
    run.publish()
    run.discard()
    assert shown(run)[:2] == ["newest", "newest"]
    assert sorted(path.name for path in run.path.parent.iterdir()) == [os.readlink(run.path), "cube"]


def test_something_else_with_the_name_of_the_link_is_not_replaced(tmp_path):
    (tmp_path / "cube").mkdir()
    with pytest.raises(IrlosError, match="is in the way"):
        PublishedRun(tmp_path / "cube").prepare()
