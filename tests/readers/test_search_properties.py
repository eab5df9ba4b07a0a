"""Whatever links a folder holds, the search ends and finds every recording once (property-based)."""

import os
import tempfile
from pathlib import Path

from helpers.patience import within
from hypothesis import given, settings
from hypothesis import strategies as st

from irlos_pipe.readers.find import each_once, files_by_folder

FOLDERS = st.sampled_from(["a", "b", "a/c", "b/d", "a/c/e"])
LINKS = st.tuples(
    FOLDERS, st.sampled_from("xyz"), st.sampled_from([".", "..", "../..", "a", "b/d", "gone", "x"])
)


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(files=st.sets(FOLDERS, min_size=1), links=st.lists(LINKS, max_size=8))
def test_every_file_is_found_once_and_links_give_way(files, links):
    with tempfile.TemporaryDirectory() as place, within(20):
        root = Path(place).resolve()
        for folder in ("a/c/e", "b/d"):
            (root / folder).mkdir(parents=True)
        for folder in files:
            (root / folder / "r.fits").touch()
        for where, name, target in links:
            link = root / where / name
            if not link.is_symlink():
                link.symlink_to(target if target in (".", "..", "gone", "x") else os.path.join(root, target))
        found = each_once([file for group, _ in files_by_folder(root, _refused) for file in group])
        assert sorted(found) == sorted(root / folder / "r.fits" for folder in files)


def _refused(folder: Path, error: Exception) -> None:
    raise error
