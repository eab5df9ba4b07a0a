"""Where a reduction stands: the old products can be read until all the new ones are there.

``<recipe>`` is a link to one of two hidden folders beside it, ``.<recipe>.a`` and ``.<recipe>.b``. Work is
done in the other one; the link is replaced, in one step of the file system, when that is complete.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.product.runfolder import LOCK_NAME, RunFolder

SLOTS = ("a", "b")


@dataclass(frozen=True)
class Place:
    """The place of one reduction.

    Attributes
    ----------
    path : Path
        The link under which its latest complete products are found.
    """

    path: Path

    @property
    def published(self) -> bool:
        """Whether there is a complete set of products."""
        return self.path.is_symlink() and self.path.is_dir()

    @property
    def workplace(self) -> Path:
        """The folder for the next set of products; may not exist, or hold what an interruption left."""
        target = os.readlink(self.path) if self.path.is_symlink() else ""
        return next(slot for slot in map(self._hidden, SLOTS) if slot.name != target)

    def prepare(self) -> Path:
        """Return the workplace; when nothing was begun there, the published products are in it.

        Raises
        ------
        IrlosError
            When the place is taken by something else, or cannot be written.
        """
        if self.path.exists() and not self.path.is_symlink():
            raise IrlosError(f"{self.path}: is in the way; it was not made by irlos night, move it elsewhere")
        try:
            self._begin()
        except OSError as error:
            raise IrlosError(f"{self.path}: cannot be written: {error.strerror or error}") from error
        return self.workplace

    def publish(self) -> None:
        """Let the products of the workplace take the place of those before, which are then removed."""
        new, old = self.workplace, self.path.resolve() if self.published else None
        link = self._hidden("link")
        link.unlink(missing_ok=True)
        link.symlink_to(new.name)
        os.replace(link, self.path)
        if old is not None:
            self._remove(old)

    def discard(self) -> None:
        """Remove what was begun and is not wanted any more."""
        self._remove(self.workplace)

    def _begin(self) -> None:
        """Fill an absent workplace in one step, so that a half filled one is never gone on with."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.workplace.exists() or not self.published:
            return
        copy = self._hidden("copy")
        self._remove(copy)
        others = shutil.ignore_patterns(LOCK_NAME)
        shutil.copytree(self.path.resolve(), copy, ignore=others, copy_function=_link_or_copy)
        os.rename(copy, self.workplace)

    def _remove(self, folder: Path) -> None:
        """Move away first: a folder half removed must not look like one half made."""
        rubbish = self._hidden("rubbish")
        shutil.rmtree(rubbish, ignore_errors=True)
        if folder.exists():
            os.rename(folder, rubbish)
            shutil.rmtree(rubbish, ignore_errors=True)

    def _hidden(self, ending: str) -> Path:
        return self.path.with_name(f".{self.path.name}.{ending}")


def _link_or_copy(source: str, target: str) -> None:
    """Products are never changed in place, so both sets may share a file; the log grows, and may not."""
    if Path(source).name == RunFolder(Path(source).parent).log.name:
        shutil.copy2(source, target)
        return
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
