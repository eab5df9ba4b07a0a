"""Products that can be read until all the new ones are complete.

Work is done in a hidden folder, ``.<recipe>.new``; when that is complete it takes the place of ``<recipe>``
by two renames, which any disk can do. A run that is killed between them is completed by the next one.
"""

import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.product.runfolder import EARLIER, LOCK_NAME, RunFolder

EARLIER_SLOTS = ("a", "b")  # folders to one of which `path` was a link in trees of earlier versions


@dataclass(frozen=True)
class PublishedRun:
    """Where the latest complete products of a reduction are found, and where the next ones are made."""

    path: Path

    @property
    def published(self) -> bool:
        """Whether there is a complete set of products, made by a run and not by somebody else."""
        linked = self.path.is_symlink() and self.path.is_dir()  # moved away, or by an earlier version
        return linked or RunFolder(self.path).recipe.is_file()

    @property
    def work_folder(self) -> Path:
        """The folder of the next set of products; it may not exist, or hold what an interruption left."""
        return self._hidden("new")

    def prepare(self) -> Path:
        """Return the work folder; it starts with the published products unless work has begun there.

        Raises `IrlosError` when something else has this name, a folder above it is a link, or the folder
        cannot be written.
        """
        for folder in (self.path.parent.parent, self.path.parent):
            if folder.is_symlink():
                raise IrlosError(f"{folder}: is a link, through which nothing is written; put a folder there")
        if self.path.exists() and not self.published:
            raise IrlosError(f"{self.path}: is in the way; it was not made by irlos night, move it elsewhere")
        try:
            self._fill_work_folder()
        except OSError as error:
            raise IrlosError(f"{self.path}: cannot be written: {error.strerror or error}") from error
        return self.work_folder

    def publish(self) -> None:
        """Replace the published products by those of the work folder, and remove the old ones.

        Raises `IrlosError` when they cannot be replaced; both sets are then still there.
        """
        old = self._hidden("old")
        try:
            if os.path.lexists(self.path):
                self.remove(old)
                os.rename(self.path, old)
            os.rename(self.work_folder, self.path)
        except OSError as error:
            if not os.path.lexists(self.path):
                with suppress(OSError):
                    os.rename(old, self.path)
            raise IrlosError(
                f"{self.path}: cannot be replaced by the new products ({error.strerror or error}); close what"
                " reads it, the next irlos night tries it again"
            ) from error
        for ending in ("old", *EARLIER_SLOTS):
            self.remove(self._hidden(ending))

    def _fill_work_folder(self) -> None:
        """Fill an absent work folder in one step, so that a half filled one is never continued."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self._hidden("old").exists() and not self.published and self.work_folder.exists():
            self.publish()  # a run was killed between the two renames
        if self.work_folder.exists() or not self.published:
            return
        copy = self._hidden("copy")
        self.remove(copy)
        others = shutil.ignore_patterns(f"{LOCK_NAME}*", EARLIER)
        shutil.copytree(self.path.resolve(), copy, ignore=others, copy_function=_link_or_copy)
        os.rename(copy, self.work_folder)

    def remove(self, folder: Path) -> None:
        """Rename before removing: a half removed folder must not look like a half filled one."""
        rubbish = self._hidden("rubbish")
        shutil.rmtree(rubbish, ignore_errors=True)
        if folder.is_symlink():
            folder.unlink()
        elif folder.exists():
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
