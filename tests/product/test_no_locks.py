"""Runs and products on disks that answer a lock with an error, as NFS and Lustre do when mounted without."""

import errno
import fcntl
import logging

import h5py
import numpy as np
import pytest

from irlos_pipe.conventions.errors import InputDataError, Locked
from irlos_pipe.files.atomic import ENOTSUPP
from irlos_pipe.product.product import Product, Quantity
from irlos_pipe.product.runfolder import SOFT_LOCK_NAME, owned_folder
from irlos_pipe.product.storage import open_product, read_product, write_product

PRODUCT = Product("ingest", {"a": Quantity(np.arange(3.0), "")}, {}, [], {}, {"key": "abc"}, [])


@pytest.fixture(params=[errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, ENOTSUPP])
def no_locks(request, monkeypatch):
    def refused(*_):
        raise OSError(request.param, "no locks here")

    for name in ("flock", "lockf"):
        monkeypatch.setattr(fcntl, name, refused)


def test_a_folder_is_owned_by_a_file_with_a_note_and_free_afterwards(tmp_path, no_locks, caplog):
    with caplog.at_level(logging.WARNING), owned_folder(tmp_path):
        assert (tmp_path / SOFT_LOCK_NAME).exists()
    assert caplog.messages == [f"{tmp_path}: this disk has no locks; .lock.soft keeps other runs away"]
    assert not list(tmp_path.iterdir())
    with owned_folder(tmp_path):
        pass


def test_a_second_run_is_kept_away_and_told_which_file_to_remove(tmp_path, no_locks):
    with (
        owned_folder(tmp_path),
        pytest.raises(Locked, match=f"if it was killed, remove {tmp_path / SOFT_LOCK_NAME}"),
        owned_folder(tmp_path),
    ):
        pass


def test_a_product_is_read_while_another_program_has_it_locked(tmp_path):
    path = tmp_path / "01_ingest.h5"
    write_product(PRODUCT, path)
    with open(path, "rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert read_product(path).arrays["a"].value.tolist() == [0, 1, 2]
        assert open_product(path).arrays["a"].value.tolist() == [0, 1, 2]


def test_an_error_of_the_disk_is_no_reason_to_remove_a_product(tmp_path, monkeypatch):
    path = tmp_path / "01_ingest.h5"
    write_product(PRODUCT, path)

    def stale(*_, **__):
        raise OSError(errno.ESTALE, "Stale file handle")

    monkeypatch.setattr(h5py, "File", stale)
    with pytest.raises(InputDataError, match=r"cannot be read: .*Stale file handle") as caught:
        read_product(path)
    assert "remove" not in str(caught.value)
