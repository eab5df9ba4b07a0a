"""Products that can be read until all the new ones are complete.

``<recipe>`` is a symbolic link to one of two hidden folders beside it, ``.<recipe>.a`` and ``.<recipe>.b``.
Work is done in the other one; when that is complete the link is replaced in one step of the file system.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.product.runfolder import EARLIER, LOCK_NAME, RunFolder

SLOTS = ("a", "b")


@dataclass(frozen=True)
class PublishedRun:
    """The two product folders of one reduction.

    Attributes
    ----------
    path : Path
        The link under which the latest complete products are found.
    """

    path: Path

    @property
    def published(self) -> bool:
        """Whether there is a complete set of products."""
        return self.path.is_symlink() and self.path.is_dir()

    @property
    def work_folder(self) -> Path:
        """The folder of the next set of products; it may not exist, or hold what an interruption left."""
        target = os.readlink(self.path) if self.path.is_symlink() else ""
        return next(slot for slot in map(self._hidden, SLOTS) if slot.name != target)

    def prepare(self) -> Path:
        """Return the work folder; it starts with the published products unless work has begun there.

        Raises
        ------
        IrlosError
            When something else has this name, a folder above it is a link, or the folder cannot be written.
        """
        for folder in (self.path.parent.parent, self.path.parent):
            if folder.is_symlink():
                raise IrlosError(f"{folder}: is a link, through which nothing is written; put a folder there")
        if self.path.exists() and not self.path.is_symlink():
            raise IrlosError(f"{self.path}: is in the way; it was not made by irlos night, move it elsewhere")
        try:
            self._fill_work_folder()
        except OSError as error:
            raise IrlosError(f"{self.path}: cannot be written: {error.strerror or error}") from error
        return self.work_folder

    def publish(self) -> None:
        """Replace the published products by those of the work folder, and remove the old ones."""
        new, old = self.work_folder, self._published_slot()
        link = self._hidden("link")
        link.unlink(missing_ok=True)
        link.symlink_to(new.name)
        os.replace(link, self.path)
        if old is not None:
            self._remove(old)

    def discard(self) -> None:
        """Remove the work folder."""
        self._remove(self.work_folder)

    def _published_slot(self) -> Path | None:
        """The folder that the link leads to, if it is one of ours: another one is somebody else's."""
        target = os.readlink(self.path) if self.path.is_symlink() else ""
        return next((slot for slot in map(self._hidden, SLOTS) if slot.name == target), None)

    def _fill_work_folder(self) -> None:
        """Fill an absent work folder in one step, so that a half filled one is never continued."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.work_folder.exists() or not self.published:
            return
        copy = self._hidden("copy")
        self._remove(copy)
        others = shutil.ignore_patterns(LOCK_NAME, EARLIER)
        shutil.copytree(self.path.resolve(), copy, ignore=others, copy_function=_link_or_copy)
        os.rename(copy, self.work_folder)

    def _remove(self, folder: Path) -> None:
        """Rename before removing: a half removed folder must not look like a half filled one."""
        rubbish = self._hidden("rubbish")
        shutil.rmtree(rubbish, ignore_errors=True)
        if folder.exists():
            os.rename(folder, rubbish)
            shutil.rmtree(rubbish, ignore_errors=True)

    def _hidden(self, ending: str) -> Path:
        return self.path.with_name(f".{self.path.name}.{ending}")


def _link_or_copy(source: str, target: str) -> None:
    """Products are never changed in place, so both sets may share a file; the log grows and must not."""
    if Path(source).name == RunFolder(Path(source).parent).log.name:
        shutil.copy2(source, target)
        return
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
