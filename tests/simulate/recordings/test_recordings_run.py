"""Running a simulation: what is made, what is skipped and why, and that nothing half done is ever seen."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from filelock import FileLock
from helpers.simulation_specs import CUBE, RAMP, simulated, spec_of

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError, Locked
from irlos_pipe.simulate.recordings import run as making

NIGHT = {"cube": CUBE, "ramp": RAMP}
HIDDEN = {"companion": {"flux_ratio": 0.1, "sep_mas": 90, "pa_deg": 0}}


def checksums(folder: Path) -> dict[str, str]:
    """SHA-256 of every visible file."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def made(steps) -> list[str]:
    return [step.planned.name for step in steps if step.reason]


@pytest.mark.slow
def test_the_same_spec_and_seed_make_the_same_bytes_whatever_the_number_of_processes(tmp_path):
    pair = {"cube": CUBE, "faint": CUBE | {"mag_j": 12.0}}
    sky = spec_of(pair, sky={"seeing_arcsec": 0.5}, motion={}, ncpa={"total_nm": 100})
    simulated(tmp_path / "one", sky)
    simulated(tmp_path / "two", sky, jobs=2)
    simulated(tmp_path / "other", sky | {"seed": 6})
    one, two, other = (checksums(tmp_path / name) for name in ("one", "two", "other"))
    assert one == two
    assert all(one[name] != other[name] for name in one if name.endswith((".json", "cube.fits")))


@pytest.mark.parametrize(
    ("change", "expected", "why"),
    [
        ({"seed": 6}, ["cube", "ramp/offset_00", "ramp/offset_01", "ramp/offset_02"], "seed"),
        ({"recordings": NIGHT | {"cube": CUBE | {"mag_j": 10.0}}}, ["cube"], "mag_j"),
        ({"recordings": NIGHT | {"cube": CUBE | {"effects": HIDDEN}}}, ["cube"], "companion"),
        (
            {"recordings": NIGHT | {"ramp": RAMP | {"offsets_nm": [-200, 0, 9]}}},
            ["ramp/offset_02"],
            "commanded_nm",
        ),
    ],
    ids=["seed", "magnitude", "effect", "offset"],
)
def test_only_what_changed_is_made_again_and_the_reason_is_told(tmp_path, change, expected, why):
    simulated(tmp_path / "out", spec_of(NIGHT))
    steps = simulated(tmp_path / "out", spec_of(NIGHT) | change)
    assert made(steps) == expected
    assert all(why in step.reason for step in steps if step.reason)


def test_data_from_elsewhere_are_never_replaced(tmp_path):
    own = tmp_path / "out" / "data" / "cube"
    own.mkdir(parents=True)
    (own / "precious.fits").write_text("night of 11 February")
    with pytest.raises(ConfigurationError, match=r"data/cube: is there, but was not made by irlos simulate"):
        simulated(tmp_path / "out", spec_of(NIGHT), force=True)
    assert [path.name for path in (tmp_path / "out").rglob("*") if path.is_file()] == ["precious.fits"]


def test_an_interruption_leaves_finished_recordings_and_nothing_half_done(tmp_path, monkeypatch):
    real = making.record

    def stops_in_the_ramp(planned, folder, spool, report):
        if planned.name == "ramp/offset_01":
            (folder / "offset_01.fits").write_text("half")
            raise KeyboardInterrupt
        return real(planned, folder, spool, report)

    monkeypatch.setattr(making, "record", stops_in_the_ramp)
    with pytest.raises(KeyboardInterrupt):
        simulated(tmp_path / "out", spec_of(NIGHT))
    left = checksums(tmp_path / "out")
    assert "data/ramp/offset_00/offset_00.fits" in left and not any("offset_01" in name for name in left)
    assert not list((tmp_path / "out").glob(".simulating-*"))
    monkeypatch.undo()
    assert made(simulated(tmp_path / "out", spec_of(NIGHT))) == ["ramp/offset_01", "ramp/offset_02"]


def test_a_recording_that_fails_while_it_is_replaced_leaves_the_old_one(tmp_path, monkeypatch):
    simulated(tmp_path / "out", spec_of({"cube": CUBE}))
    before = checksums(tmp_path / "out" / "data")

    def full_disk(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(making, "record", full_disk)
    with pytest.raises(IrlosError, match="the disk is full"):
        simulated(tmp_path / "out", spec_of({"cube": CUBE | {"mag_j": 10.0}}))
    assert checksums(tmp_path / "out" / "data") == before


def test_a_folder_in_use_is_left_alone(tmp_path):
    (tmp_path / "out").mkdir()
    with FileLock(tmp_path / "out" / ".lock"), pytest.raises(Locked):
        simulated(tmp_path / "out", spec_of({"cube": CUBE}))
