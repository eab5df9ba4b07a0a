"""Old products can be read until the new ones take their place, whenever the process is killed."""

import os
import shutil

import pytest

from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.night.reduce import PublishedRun
from irlos_pipe.product.runfolder import owned_folder


def work(run: PublishedRun, content: str) -> None:
    """Make products as a run does: each in a new file; the log grows."""
    with owned_folder(run.prepare()) as folder:
        for name in ("a.h5", "b.h5", "recipe.resolved.yaml"):
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


def test_work_starts_with_hard_links_to_the_published_products_and_is_continued(run):
    begun = run.prepare()
    (begun / "c.h5").touch()
    assert (run.prepare() / "c.h5").is_file()
    assert os.path.samefile(begun / "a.h5", run.path / "a.h5")
    assert not os.path.samefile(begun / "run.log", run.path / "run.log")
    assert not (begun / ".lock").exists()


def test_a_half_filled_work_folder_of_a_killed_run_is_not_continued(run, monkeypatch):
    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            run.prepare()
    assert not run.work_folder.exists()
    there = ["a.h5", "b.h5", "recipe.resolved.yaml", "run.log"]
    assert sorted(path.name for path in run.prepare().iterdir()) == there


class Killed(BaseException):
    """Nothing is done after it."""


def stopped_at(count: int, error: BaseException, rename=os.rename):
    """Renames of which the one of that number does not happen."""
    renames = iter(range(count + 1))

    def rename_or_stop(*paths, **options):
        if next(renames, count + 1) == count:
            raise error
        rename(*paths, **options)

    return rename_or_stop


@pytest.mark.parametrize(("count", "seen"), [(0, ["old"]), (1, []), (2, ["new"])])
def test_a_kill_at_any_rename_shows_no_half_and_the_next_night_heals_it(run, monkeypatch, count, seen):
    work(run, "new")
    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", stopped_at(count, Killed()))
        with pytest.raises(Killed):
            run.publish()
    assert [(run.path / "a.h5").read_text() for _ in seen] == seen and run.published == bool(seen)
    run.prepare()
    assert shown(run)[:2] == (["old", "old"] if seen == ["old"] else ["new", "new"])
    work(run, "newest")
    run.publish()
    assert shown(run)[:2] == ["newest", "newest"]
    assert [path.name for path in run.path.parent.iterdir()] == ["cube"]


@pytest.mark.parametrize("count", [0, 1])
def test_a_disk_that_refuses_a_rename_keeps_both_sets(run, monkeypatch, count):
    work(run, "new")
    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", stopped_at(count, PermissionError(13, "Permission denied")))
        with pytest.raises(IrlosError, match=r"replaced by the new products \(Permission denied\)"):
            run.publish()
    assert shown(run)[:2] == ["old", "old"]
    run.publish()
    assert shown(run)[:2] == ["new", "new"]


def test_a_kill_while_the_old_products_are_removed_leaves_the_new_ones(run, monkeypatch):
    work(run, "new")
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", stopped_at(2, Killed(), shutil.rmtree))
        with pytest.raises(Killed):
            run.publish()
    assert shown(run)[:2] == ["new", "new"]
    work(run, "newest")
    run.publish()
    assert [path.name for path in run.path.parent.iterdir()] == ["cube"]


def test_a_tree_of_earlier_versions_with_links_goes_on_without(run):
    os.rename(run.path, run.path.with_name(".cube.b"))
    run.path.symlink_to(".cube.b")
    run.path.with_name(".cube.a").mkdir()  # what an interruption left
    assert run.published and shown(run)[:2] == ["old", "old"]
    work(run, "new")
    run.publish()
    assert shown(run) == ["new", "new", "oldnew"] and not run.path.is_symlink()
    assert [path.name for path in run.path.parent.iterdir()] == ["cube"]


def test_products_are_published_on_a_disk_without_links(run, monkeypatch):
    def unsupported(*_, **__):
        raise OSError(95, "Operation not supported")

    for name in ("symlink", "link"):
        monkeypatch.setattr(os, name, unsupported)
    work(run, "new")
    run.publish()
    assert shown(run) == ["new", "new", "oldnew"]
