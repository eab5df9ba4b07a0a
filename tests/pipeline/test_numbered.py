"""Versions of a reduction side by side: what is there is not changed, the link leads to what is whole."""

import os

import pytest
from conftest import Bench, invoke, products
from filelock import FileLock

from irlos_pipe.product.run_table import link_latest, version_folders


def numbered(bench: Bench, *options: str) -> int:
    return bench.run("--numbered", *options).exit_code


def there(bench: Bench) -> list[str]:
    return [path.name for path in version_folders(bench.output)]


def content(bench: Bench, version: str) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (bench.output / version).glob("*.h5")}


def test_the_first_version_is_the_latest_and_the_same_reduction_again_up_to_date(bench):
    assert numbered(bench) == 0
    assert there(bench) == ["001"] and os.readlink(bench.output / "latest") == "001"
    before = content(bench, "001")
    assert len(products(bench.output / "latest")) == 3
    assert numbered(bench) == 0 and there(bench) == ["001"] and content(bench, "001") == before


@pytest.mark.parametrize("option", [("--set", "calibrate.method=dip_global"), ("--force",), ()])
def test_a_reduction_that_would_replace_products_begins_a_version(bench, option):
    numbered(bench)
    before = content(bench, "001")
    if not option:
        (bench.data / "c.dat").write_bytes(b"1")
    assert numbered(bench, *option) == 0
    assert there(bench) == ["001", "002"] and os.readlink(bench.output / "latest") == "002"
    assert content(bench, "001") == before


def test_a_version_that_stopped_is_continued_and_the_link_stays_until_it_is_whole(bench):
    numbered(bench)
    bench.make("calibrate.crash")
    changed = ("--set", "ingest.scale=2")
    assert numbered(bench, *changed) == 1
    assert there(bench) == ["001", "002"] and os.readlink(bench.output / "latest") == "001"
    (bench.data / "calibrate.crash").unlink()
    # what made it crash was an input file, so that ingest differs: a version that stopped early is kept
    assert numbered(bench, *changed) == 0
    assert there(bench)[-1] == os.readlink(bench.output / "latest")


@pytest.mark.parametrize("make", ["file", "run"])
def test_a_folder_of_something_else_is_refused(bench, make):
    if make == "run":
        bench.run()
    else:
        bench.output.mkdir()
        (bench.output / "mine.txt").touch()
    result = bench.run("--numbered")
    assert result.exit_code == 2 and "holds other files" in result.stderr


def test_a_folder_of_versions_is_no_run_and_the_message_says_where_one_is(bench):
    numbered(bench)
    assert "holds other files (001 (and" not in bench.run().stdout
    result = invoke("report", str(bench.output))
    assert result.exit_code == 3 and f"{bench.output / 'latest'}" in result.stderr


def test_latest_that_is_no_link_is_refused_and_left_alone(bench):
    numbered(bench)
    (bench.output / "latest").unlink()
    (bench.output / "latest").mkdir()
    result = bench.run("--numbered", "--force")
    assert result.exit_code == 2 and "latest: is no link" in result.stderr
    link_latest(bench.output, bench.output / "001")
    assert {path.name for path in bench.output.iterdir()} == {".lock", "001", "latest"}


def test_on_a_disk_without_links_the_newest_version_is_named(bench, monkeypatch):
    def unsupported(*_, **__):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(os, "symlink", unsupported)
    for option in ((), ("--force",)):
        result = bench.run("--numbered", *option)
        assert result.exit_code == 0
    assert f"the newest complete version is {bench.output / '002'}" in result.stderr
    assert "latest" in invoke("status", str(bench.output)).stdout.splitlines()[2]
    assert f"{bench.output / '002'}" in invoke("report", str(bench.output)).stderr


def test_two_runs_do_not_share_a_number(bench):
    numbered(bench)
    with FileLock(bench.output / ".lock"):
        assert numbered(bench, "--force") == 75
    assert there(bench) == ["001"]
