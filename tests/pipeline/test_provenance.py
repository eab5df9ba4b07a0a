"""Where a product comes from: the revision of the software, with git or without."""

import subprocess

import pytest

import irlos_pipe
from irlos_pipe.pipeline import provenance


@pytest.fixture
def version(monkeypatch):
    """Return the version that a package in a folder states."""

    def stated(folder) -> str:
        monkeypatch.setattr(irlos_pipe, "__file__", str(folder / "irlos_pipe" / "__init__.py"))
        provenance.software_versions.cache_clear()
        return provenance.software_versions()["irlos_pipe"]

    yield stated
    provenance.software_versions.cache_clear()


def git(folder, *arguments):
    identity = ("-c", "user.name=x", "-c", "user.email=x@example.org")
    return subprocess.run(
        ["git", "-C", folder, *identity, *arguments], check=True, capture_output=True, text=True
    )


@pytest.fixture
def checkout(tmp_path):
    git(tmp_path, "init", "-q")
    (tmp_path / "file").write_text("1")
    git(tmp_path, "add", "file")
    git(tmp_path, "commit", "-qm", "one")
    return tmp_path


def test_a_checkout_states_its_revision_and_whether_it_was_changed(version, checkout):
    revision = git(checkout, "rev-parse", "--short", "HEAD").stdout.strip()
    assert version(checkout) == f"{irlos_pipe.__version__}+git.{revision}"
    (checkout / "file").write_text("2")
    git(checkout, "tag", "-a", "v1", "-m", "v1")  # does not hide the revision
    assert version(checkout) == f"{irlos_pipe.__version__}+git.{revision}.dirty"
