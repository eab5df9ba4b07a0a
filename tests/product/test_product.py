"""The product file: what goes in comes out, whole or not at all."""

import errno
import hashlib
from dataclasses import replace

import h5py
import numpy as np
import pytest

from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.files import atomic
from irlos_pipe.files.json import json_text, jsonable
from irlos_pipe.product import storage
from irlos_pipe.product import storage as seal
from irlos_pipe.product.product import Check, Product, Quantity
from irlos_pipe.product.storage import open_product, read_product, write_product


def make_product(**changes) -> Product:
    rng = np.random.default_rng(1)
    arrays = {
        "recordings/sky/images_e": Quantity(rng.normal(size=(5, 32, 32)).astype(np.float32), "e-", "frames"),
        "zernike_nm": Quantity(np.array([1.0, -2.0]), "nm", error=np.array([0.1, 0.2])),
        "used": Quantity(np.array([True, False]), ""),
        "reason": Quantity(np.array(["", "cosmic ray – hit"], dtype=object), ""),
        "acquisition": Quantity(np.asarray('{"mag_j": 7}'), ""),
        "empty": Quantity(np.zeros((0, 4)), "e-"),
    }
    product = Product(
        "ingest",
        arrays,
        {"frames": np.int64(5), "flux_e": float("nan")},
        [Check("chi2", 1.1, "", 0.5, 1.5, "fits")],
        {"method": "x"},
        {"key": "abc"},
        ["INFO read"],
    )
    return replace(product, **changes)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "01_ingest.h5"


@pytest.mark.parametrize("name", list(make_product().arrays))
def test_every_array_comes_back_with_type_unit_description_and_error(path, name):
    written = make_product().arrays[name]
    write_product(make_product(), path)
    read = read_product(path).arrays[name]
    assert np.array_equal(read.value, written.value) and read.value.shape == written.value.shape
    assert read.value.dtype.kind == written.value.dtype.kind or read.value.dtype.kind == "U"
    assert (read.unit, read.description) == (written.unit, written.description)
    assert (read.error is None) == (written.error is None)
    assert read.error is None or np.array_equal(read.error, written.error)


def test_results_checks_configuration_provenance_and_log_come_back(path):
    written = make_product()
    write_product(written, path)
    read = read_product(path)
    assert read.results == {"frames": 5, "flux_e": None}
    assert (read.stage, read.checks, read.config) == (written.stage, written.checks, written.config)
    assert (read.provenance, read.log) == (written.provenance, written.log)
    assert read_product(path, arrays=False) == replace(read, arrays={})
    write_product(replace(written, checks=[Check("x", float("nan"), "nm", None, 1.0, "")]), path)
    assert not read_product(path).checks[0].passed


def test_equal_products_make_equal_files(path, tmp_path):
    write_product(make_product(), path)
    write_product(make_product(), tmp_path / "again.h5")
    assert path.read_bytes() == (tmp_path / "again.h5").read_bytes()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_truncated_product_is_reported_with_its_name(path, share):
    write_product(make_product(), path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputDataError, match=r"01_ingest.h5: not a readable product"):
        read_product(path)


def flipped(path, place):
    changed = bytearray(path.read_bytes())
    changed[place] ^= 1
    path.write_bytes(changed)


@pytest.mark.slow
def test_a_flipped_bit_anywhere_is_noticed(path):
    write_product(make_product(), path)
    content = path.read_bytes()
    # what comes before is the checksum itself, or the padding behind it
    for place in np.random.default_rng(3).integers(seal.HEAD_BYTES, len(content), size=200):
        path.write_bytes(content)
        flipped(path, place)
        with pytest.raises(InputDataError, match="does not fit its checksum"):
            read_product(path)
        with pytest.raises(InputDataError, match="does not fit its checksum"):
            open_product(path).arrays["zernike_nm"]


@pytest.mark.slow
def test_a_flipped_bit_in_the_metadata_is_noticed_when_nothing_else_is_read(path):
    write_product(make_product(), path)
    content = path.read_bytes()
    length = int(content.split(b"metadata ")[1].split()[0])
    for place in range(seal.HEAD_BYTES, seal.HEAD_BYTES + length):
        path.write_bytes(content)
        flipped(path, place)
        with pytest.raises(InputDataError, match="does not fit its checksum"):
            read_product(path, arrays=False)


def test_arrays_are_read_when_they_are_asked_for(path, monkeypatch):
    write_product(make_product(), path)
    opened, whole = open_product(path), read_product(path)
    read = []
    real = storage._read_array
    monkeypatch.setattr(storage, "_read_array", lambda dataset: read.append(dataset.name) or real(dataset))
    for _ in range(2):
        assert np.array_equal(opened.arrays["zernike_nm"].error, whole.arrays["zernike_nm"].error)
    assert sorted(read) == ["/arrays/zernike_nm", "/errors/zernike_nm"]
    assert dict(opened.arrays).keys() == whole.arrays.keys() and "gone" not in opened.arrays


@pytest.mark.parametrize("change", [lambda content: content[:-1], lambda content: content + b"x"])
def test_a_file_of_another_length_is_noticed_by_its_metadata(path, change):
    write_product(make_product(), path)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(InputDataError, match="does not fit its checksum"):
        read_product(path, arrays=False)


def test_a_product_of_an_earlier_version_without_metadata_in_front_is_read(path):
    """The checksum of all alone, as it was written before."""
    write_product(make_product(), path)
    whole = read_product(path)
    hdf5 = path.read_bytes()[block_of(path) :]
    line = seal.MARK + hashlib.sha256(hdf5).hexdigest().encode() + b"\n"
    path.write_bytes(line.ljust(seal.HEAD_BYTES, b"\0") + hdf5)
    assert read_product(path, arrays=False) == replace(whole, arrays={})
    assert open_product(path).arrays.keys() == whole.arrays.keys()
    flipped(path, len(hdf5))
    with pytest.raises(InputDataError, match="does not fit its checksum"):
        read_product(path, arrays=False)


def block_of(path):
    return path.read_bytes().index(b"\x89HDF\r\n\x1a\n")


@pytest.mark.parametrize("sealed", [False, True])
@pytest.mark.parametrize(
    ("forge", "reason"),
    [
        (
            lambda file: file.__setitem__("arrays/x", h5py.ExternalLink("/etc/passwd", "/x")),
            "link to elsewhere",
        ),
        (lambda file: file.__setitem__("arrays/x", h5py.SoftLink("/arrays")), "link to elsewhere"),
        (
            lambda file: file.create_dataset("x", (9,), "u1", external=[("/etc/passwd", 0, 9)]),
            "in another file",
        ),
        (lambda file: file.create_dataset("x", (10**7, 10**7), "f8", chunks=(10, 10)), "that are not stored"),
        (lambda file: file.__setitem__("arrays/x", file["arrays"]), "not a readable product"),
    ],
)
def test_what_leads_out_of_a_product_or_is_not_in_it_is_refused(path, forge, reason, sealed):
    """Without a seal at once, with one that fits when an array is read."""
    write_product(make_product(), path)
    metadata = seal.sealed_metadata(path)
    if not sealed:
        path.write_bytes(path.read_bytes()[block_of(path) :])
    with h5py.File(path, "r+") as file:
        forge(file)
    if sealed:
        content = bytearray(path.read_bytes())
        seal.seal(memoryview(content), metadata)
        path.write_bytes(content)
    with pytest.raises(InputDataError, match=reason):
        _ = open_product(path).arrays["zernike_nm"] if sealed else read_product(path, arrays=False)


def write_hdf5(path):
    with h5py.File(path, "w") as file:
        file["x"] = 1


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("01_ingest.h5", lambda path: path.write_text("SIMPLE  =     T"), "not a readable product"),
        ("01_ingest.h5", write_hdf5, "not a product of irlos"),
        ("01_ingest.h5", lambda path: None, "no such product"),
        # nobody is told to remove a file of his own
        ("README.md", lambda path: path.write_text("# mine"), "not a product; those of a run are named"),
    ],
)
def test_what_is_no_product_is_refused_with_its_name(tmp_path, name, write, message):
    write(tmp_path / name)
    with pytest.raises(InputDataError, match=message) as problem:
        read_product(tmp_path / name)
    assert name in str(problem.value)
    assert name != "README.md" or "run again" not in str(problem.value)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES])
def test_a_failed_write_keeps_the_old_product_and_leaves_nothing_else(path, monkeypatch, code):
    write_product(make_product(), path)
    before = path.read_bytes()

    def refuse(*_):
        raise OSError(code, "refused")

    monkeypatch.setattr(atomic.os, "fsync", refuse)
    with pytest.raises(IrlosError, match=r"01_ingest.h5: cannot be written: refused"):
        write_product(make_product(results={}), path)
    assert path.read_bytes() == before and [file.name for file in path.parent.iterdir()] == [path.name]


def test_a_file_with_the_same_content_is_not_written_again(tmp_path):
    path = tmp_path / "results.json"
    assert atomic.write_if_changed(path, b"1") and not atomic.write_if_changed(path, b"1")
    assert atomic.write_if_changed(path, b"2") and path.read_bytes() == b"2"


@pytest.mark.parametrize(
    ("value", "low", "high", "passed"),
    [
        (1.0, 0.5, 1.5, True),
        (0.5, 0.5, None, True),
        (0.4, 0.5, None, False),
        (1.6, None, 1.5, False),
        (float("nan"), None, None, False),
        (-5.0, None, 0.0, True),
    ],
)
def test_a_check_passes_inside_its_limits_only(value, low, high, passed):
    assert Check("x", value, "nm", low, high, "").passed is passed


def test_json_has_neither_nan_nor_numpy_types():
    content = {
        2: np.float32(0.5),
        "x": np.array([1.0, np.inf]),
        "n": None,
        "t": (np.bool_(True), float("nan")),
    }
    assert jsonable(content) == {"2": 0.5, "x": [1.0, None], "n": None, "t": [True, None]}
    assert "NaN" not in json_text(content)
    with pytest.raises(TypeError, match="no JSON form"):
        jsonable(object())
