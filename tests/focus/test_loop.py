"""What a loop that is started again begins with. Truth: the command that an earlier loop has left."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from helpers import focus_loop as made
from scipy.ndimage import gaussian_filter

from irlos_pipe.control.controller import ControllerSettings
from irlos_pipe.control.exposures import Accumulator
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.focus.calibration import Ordinary, SharedErrors, optical_differences, stated_differences
from irlos_pipe.focus.journal import event_line, record_of
from irlos_pipe.focus.mailbox import Command, Mailbox
from irlos_pipe.focus.service import FocusLoop, LoopSettings
from irlos_pipe.readers.sidecar import AcquisitionKeys
from irlos_pipe.stages.lift.stage import LiftResults, Point

SETTINGS = LoopSettings(ControllerSettings(gain=0.5, delay=0))


def ran(output, first: int, last: int, settings=SETTINGS) -> list[str]:
    return made.served(output, made.Listed([[made.read(n, 40.0)] for n in range(first, last)]), settings)


def command(output) -> Command:
    box = Mailbox(output / "command")
    found = box.read()
    box.close()
    assert found is not None
    return found


@pytest.fixture
def left(tmp_path):
    ran(tmp_path, 0, 4)
    return tmp_path


def goes_on(output, before: Command) -> list[str]:
    """The next exposure follows the offset that stood, under the next number."""
    said = ran(output, 10, 11)
    after = command(output)
    assert after.number == before.number + 1
    assert after.offset_nm == pytest.approx(before.offset_nm + 0.5 * 40.0, abs=3.0)
    return said


def lines(output) -> list[bytes]:
    return (output / "focus.jsonl").read_bytes().splitlines(True)


@pytest.mark.parametrize("kept", [0, 1, 3, 5], ids=lambda kept: f"{kept} lines kept")
def test_whatever_is_lost_of_the_record_the_offset_that_stands_is_kept(left, kept):
    before = command(left)
    (left / "focus.jsonl").write_bytes(b"".join(lines(left)[:kept]))
    said = goes_on(left, before)
    assert (f"no record; goes on from command 4, {before.offset_nm:.1f} nm" in said) == (kept < 2)


@pytest.mark.parametrize("value", [1e6, None, "text", float("inf")], ids=repr)
def test_a_forged_offset_is_not_believed(left, value):
    before = command(left)
    content = lines(left)
    content[4] = json.dumps(json.loads(content[4]) | {"offset_nm": value}).encode() + b"\n"
    (left / "focus.jsonl").write_bytes(b"".join(content))
    goes_on(left, before)


def test_where_the_end_of_the_record_and_the_command_are_lost_it_refuses(left):
    (left / "command").unlink()
    (left / "focus.jsonl").write_bytes(b"".join(lines(left)[:4]) + b"rubbish\n")
    with pytest.raises(InputDataError, match=r"offset that stands is not known.*another output"):
        ran(left, 10, 11)


def test_a_lost_or_damaged_command_is_no_matter_where_the_record_is_whole(left):
    before = command(left)
    content = bytearray((left / "command").read_bytes())
    content[20] ^= 1
    (left / "command").write_bytes(content)
    assert "the command is damaged" in ran(left, 10, 10)
    (left / "command").unlink()
    goes_on(left, before)


def test_an_offset_beyond_the_limit_is_refused(left):
    narrow = LoopSettings(ControllerSettings(gain=0.5, delay=0, limit_nm=30.0))
    with pytest.raises(InputDataError, match="beyond --limit-nm 30"):
        ran(left, 10, 11, narrow)


# From exposures to records. Truth: the defocus of the images, and the controller by itself.


def loop(settings: LoopSettings = SETTINGS, last=None) -> FocusLoop:
    return FocusLoop(made.calibration(), settings, last)


def test_the_loop_closes_from_afar_and_stays():
    running, offset, residuals = loop(), 0.0, []
    for index in range(12):
        residuals.append(800.0 - offset)
        offset = running.record(made.exposure(index, residuals[-1]), 0.0).offset_nm
    assert np.abs(residuals[-4:]).max() < 5.0
    assert residuals[1] == 400.0  # no more than a jump at a time


def test_a_loop_that_is_started_again_goes_on_to_the_bit():
    one, other = loop(), loop()
    straight = [one.record(made.exposure(index, 30.0), 0.0) for index in range(6)]
    first = [other.record(made.exposure(index, 30.0), 0.0) for index in range(3)]
    again = loop(last=record_of(first[-1].line()))
    rest = [again.record(made.exposure(index, 30.0), 0.0) for index in range(3, 6)]
    timed = {"latency_ms": 0.0, "recorded_unix_s": 0.0}
    assert [replace(one, **timed) for one in first + rest] == [replace(one, **timed) for one in straight]


def test_a_record_survives_the_line_it_is_written_as():
    record = loop().record(made.exposure(3, 123.0), 0.0)
    assert record_of(record.line()) == record
    lost = loop().record(made.exposure(3, image_e=np.full(made.WINDOW, np.nan)), 0.0)
    assert math.isnan(record_of(lost.line()).defocus_nm)
    assert record_of(event_line(3, 0.0, "started")) is None
    with pytest.raises(ValueError, match="not a record"):
        record_of('{"schema": "another"}')


@pytest.mark.parametrize(
    ("reasons", "case", "options"),
    [
        (("not_finite",), {"image_e": np.full(made.WINDOW, np.nan)}, {}),
        (("not_finite",), {"image_e": np.full(made.WINDOW, 1e38, np.float32)}, {}),
        (("window",), {"image_e": np.ones((20, 20))}, {}),
        (("lost_star",), {"flux_e": 0.0}, {}),
        (("late",), {}, {"overtaken": True}),
    ],
)
def test_the_offset_of_an_exposure_that_is_not_valid_is_held_and_the_record_says_why(reasons, case, options):
    running = loop()
    before = running.record(made.exposure(0, 50.0), 0.0)
    record = running.record(made.exposure(1, 50.0, **case), 0.0, **options)
    assert {*reasons} <= {*record.reasons}
    assert (record.valid, record.commanded, record.offset_nm) == (False, False, before.offset_nm)
    assert running.record(made.exposure(2, 50.0), 0.0).valid


def test_whatever_a_measurement_raises_becomes_a_record_and_the_offset_is_held(monkeypatch):
    running = loop()
    before = running.record(made.exposure(0, 50.0), 0.0)
    monkeypatch.setattr(type(made.calibration().sensor), "measurement", lambda *_: [][0])
    record = running.record(made.exposure(1, 50.0), 0.0)
    assert (record.valid, record.reasons, record.offset_nm) == (False, ("failed",), before.offset_nm)
    assert running.problem == "IndexError: list index out of range"
    monkeypatch.undo()
    assert running.record(made.exposure(2, 50.0), 0.0).valid
    assert running.problem == ""


def test_the_error_is_that_of_photons_with_misfit_instant_and_optics_where_a_ramp_shows_them():
    record = loop().record(made.exposure(0, 500.0), 0.0)
    optics_nm = 4.0 + record.defocus_nm / 1000.0
    expected_nm = math.sqrt(2.0 * record.sigma_photon_nm**2 + 3.0**2 + optics_nm**2)
    assert record.sigma_nm == pytest.approx(expected_nm)
    assert record.sigma_photon_nm < 1.0
    bare = FocusLoop(replace(made.calibration(), errors=None), SETTINGS)
    assert math.isnan(bare.record(made.exposure(0, 50.0), 0.0).sigma_nm)


def test_a_measurement_has_the_error_that_the_ramp_states_of_the_same_image():
    """Photons, instant and optics of 0.5, 0.2 and 0.3 nm; an offset of 25 nm, as of another night."""
    parts = {"sigma_photon_nm": 0.5, "sigma_instant_nm": 0.2, "sigma_optics_nm": 0.3, "sigma_offset_nm": 25.0}
    points = [Point(defocus_nm=nm, **parts) for nm in (-100.0, 0.0, 100.0)]
    errors = SharedErrors.of(LiftResults(calibrated=True, points=points, chi2_nu=1.0, nominal_chi2_nu=1.0))
    assert errors.sigma_nm(40.0, 0.5) == pytest.approx(np.sqrt(0.5**2 + 0.2**2 + 0.3**2 + 25.0**2))


# Whether frames are those of a calibration. Truth: acquisitions and side-cars written out.


CALIBRATED = made.calibration().acquisition


def test_the_same_frames_agree_and_scales_of_weights_do_not_matter():
    same = replace(CALIBRATED, spectrum=((1625.0, 7.0), (2000.0, 0.0)), diversity={6: -170.2, 4: 0.0})
    assert optical_differences(same, CALIBRATED) == []
    assert stated_differences(AcquisitionKeys(), CALIBRATED) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"spectrum": ((1215.0, 1.0),)}, "spectrum 1215 nm (1.00), not 1625 nm (1.00)"),
        ({"spectrum": ((1625.0, 1.0), (1215.0, 1.0))}, "1215+1625 nm (0.50+0.50)"),
        ({"pixel_scale_mas": 9.8}, "pixel_scale_mas 9.8, not 9.7"),
        ({"diversity": {6: 170.0}}, "diversity of Noll 6 170 nm, not -170"),
        ({"diversity": {6: -170.0, 5: 20.0}}, "diversity of Noll 5 20 nm, not 0"),
        ({"lenslets": 2}, "2x2 lenslets, not 1"),
    ],
)
def test_other_frames_are_told_by_what_differs(change, words):
    (line,) = optical_differences(replace(CALIBRATED, **change), CALIBRATED)
    assert words in line


# What right exposures leave beside the model. Truth: images of the model, and those spoilt by hand.


def scattered(seed: int, defocus_nm: float = 20.0, flux_e: float = made.FLUX_E) -> np.ndarray:
    """An image with speckles of some percent, as the sky makes them."""
    rng = np.random.default_rng([seed, 3])
    image = made.image_e(defocus_nm, seed, flux_e=flux_e)
    grain = gaussian_filter(rng.standard_normal(made.WINDOW), 1.0)
    return (image * (1 + 0.03 * grain / grain.std())).astype(np.float32)


@pytest.fixture(scope="module")
def ordinary() -> Ordinary:
    return Ordinary.of(made.calibration().sensor, [scattered(seed) for seed in range(14)])


def reasons(ordinary: Ordinary, image_e: np.ndarray) -> tuple[str, ...]:
    calibration = replace(made.calibration(), ordinary=ordinary)
    (exposure,) = Accumulator(1).add(made.read(0, 0.0, image_e=image_e))
    return FocusLoop(calibration, LoopSettings()).record(exposure, 0.0).reasons


@pytest.mark.parametrize("flux_e", [2e6, 2e5, 2e4, 2e3])
def test_images_like_those_of_the_ramp_fit_at_every_light(ordinary, flux_e):
    assert not any(reasons(ordinary, scattered(seed, flux_e=flux_e)) for seed in range(100, 120))


SPOILT = {
    "clipped": lambda image: np.minimum(image, 0.5 * image.max()),
    "torn": lambda image: np.concatenate([image[:16], np.roll(image[16:], 1, 1)]),
    "moved by 2 px": lambda image: (image + np.roll(image, 2, 1) + np.roll(image, -2, 1)) / 3,
    "a companion": lambda image: image + 0.3 * np.roll(image, 8, 0),
    "a gain of 1.5 in half of it": lambda image: image * np.where(np.arange(32) < 16, 1.0, 1.5),
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
@pytest.mark.parametrize("flux_e", [2e6, 2e5, 2e4])
def test_others_are_a_misfit(ordinary, spoil, flux_e):
    assert "misfit" in reasons(ordinary, spoil(scattered(200, flux_e=flux_e)))


def test_errors_of_the_ramps_own_frames_do_not_grow_and_those_of_others_do(ordinary):
    sensor = made.calibration().sensor
    frames = [sensor.measurement(scattered(seed)).beside for seed in range(14)]
    assert all(ordinary.growth(one) == (1.0, 0.0) for one in frames)
    moved = SPOILT["moved by 2 px"](scattered(200))
    factor, beside_nm = ordinary.growth(sensor.measurement(moved).beside)
    assert factor > 1.0 or beside_nm > 3.0
