"""Side-cars, and which source wins; reads and seeing as they are told. Truth: arithmetic."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.modeling.models import BlackBody
from conftest import invoke
from helpers.sparta_files import sidecar, write_muse, write_sidecar

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.laws import SeeingScale
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.acquisition import RawRecording, photons, resolve, spectrum_of
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.sidecar import AcquisitionKeys, DetectorKeys, read_sidecar
from irlos_pipe.readers.sidecar_template import proposals, sidecar_template

IRLOS = load_instrument("irlos")
SCALED = replace(IRLOS, seeing_scales=IRLOS.seeing_scales | {"mass_dimm": SeeingScale(0.75, 0.02)})
NOTHING = AcquisitionKeys()
MANY, WIDE = ([{"wavelength_nm": one} for one in nm] for nm in (range(1500, 1601), (500.0, 1600.0)))


def recording(folder: Path, frames: int = 3, header: dict | None = None) -> RawRecording:
    return RawRecording(
        name="rec",
        path=folder / "rec.fits",
        layout="fits_cube",
        adu=np.zeros((frames, 8, 8)),
        frame_counter=np.arange(frames),
        header=header or {},
    )


def test_every_key_of_the_side_car_arrives(tmp_path):
    write_sidecar(
        tmp_path / "acquisition.yaml",
        derotator_angle_deg=12.5,
        introduced_defocus_nm=-40.0,
        spectrum=[{"wavelength_nm": 1200.0, "weight": 0.5}, {"wavelength_nm": 1600.0}],
        diversity={"source": "dsm", "zernike": {5: 20.0, 6: -170}},
    )
    resolved = resolve(recording(tmp_path), NOTHING, IRLOS)
    found = resolved.acquisition
    assert (found.role, found.target, found.mag_j) == ("ncpa_calibration", "TEST", 8.0)
    assert (found.exposure_s, found.frame_rate_hz, found.pixel_scale_mas) == (0.1, 10.0, 9.7)
    assert (found.seeing_arcsec, found.derotator_angle_deg) == (0.5, 12.5)
    assert found.spectrum == ((1200.0, 0.5), (1600.0, 1.0))
    assert (found.diversity_source, found.diversity) == ("dsm", {5: 20.0, 6: -170.0})
    assert (found.detector.e_per_adu, found.detector.read_noise_e) == (0.5, 1.0)
    assert resolved.introduced_defocus_nm.tolist() == [-40.0, -40.0, -40.0]
    assert resolved.warnings == ()


def test_a_source_that_has_no_magnitude_is_nothing_to_warn_of(tmp_path):
    write_sidecar(tmp_path / "acquisition.yaml", mag_j=None)
    resolved = resolve(recording(tmp_path, header={"mag_j": 9.0}), NOTHING, IRLOS)
    assert resolved.acquisition.mag_j is None
    assert not any("mag_j" in line for line in resolved.warnings)


@pytest.mark.parametrize(
    ("angle_deg", "stated", "named"), [(800.0, None, True), (800.0, 80.0, False), (300.0, None, False)]
)
def test_an_angle_of_the_header_that_cannot_be_used_is_named(tmp_path, angle_deg, stated, named):
    write_sidecar(tmp_path / "acquisition.yaml", "derotator_angle_deg")
    keys = AcquisitionKeys(derotator_angle_deg=stated)
    found = resolve(recording(tmp_path, header={"derotator_angle_deg": angle_deg}), keys, IRLOS)
    assert found.acquisition.derotator_angle_deg == (0.0 if named else stated or angle_deg)
    assert any("derotator_angle_deg = 800 of the header" in line for line in found.warnings) == named


def test_recipe_wins_over_side_car_over_header_over_profile(tmp_path):
    write_sidecar(tmp_path / "acquisition.yaml", "seeing_arcsec", "exposure_s")
    header = {"mag_j": 11.0, "seeing_arcsec": 0.9}
    recipe = AcquisitionKeys(mag_j=7.0, detector={"read_noise_e": 3.0})
    found = resolve(recording(tmp_path, header=header), recipe, IRLOS).acquisition
    assert (found.mag_j, found.sources["mag_j"]) == (7.0, "recipe")
    assert (found.pixel_scale_mas, found.sources["pixel_scale_mas"]) == (9.7, "side-car")
    assert (found.seeing_arcsec, found.sources["seeing_arcsec"]) == (0.9, "header")
    assert found.seeing_measured
    assert (found.exposure_s, found.sources["exposure_s"]) == (0.1, "instrument profile")
    assert (found.detector.read_noise_e, found.detector.e_per_adu) == (3.0, 0.5)


@pytest.mark.parametrize(
    ("without", "changes", "message"),
    [
        *(
            (key, {}, f"key '{key}' missing, and no default is safe")
            for key in ("role", "spectrum", "diversity")
        ),
        ("introduced_defocus_nm", {"role": "defocus_ramp"}, "key 'introduced_defocus_nm' missing"),
        ("", {"introduced_defocus_nm": [-100.0, 100.0]}, "introduced_defocus_nm has 2 values for 3 frames"),
    ],
)
def test_what_has_no_safe_default_and_what_does_not_fit_is_named(tmp_path, without, changes, message):
    write_sidecar(tmp_path / "acquisition.yaml", without, **changes)
    with pytest.raises(InputDataError, match=rf"acquisition\.yaml.*{message}"):
        resolve(recording(tmp_path), NOTHING, IRLOS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("role: psf\nseing_arcsec: 0.5\n", ":2: unknown key 'seing_arcsec'; did you mean 'seeing_arcsec'"),
        ("role: calibration\n", ":1: role = 'calibration'"),
        (
            "detector:\n  e_per_adu: 0.5\n  read_noise: 1\n",
            ":3: unknown key 'detector.read_noise'; did you mean 'read_noise_e'",
        ),
        ("diversity: {source: lens, zernike: {1: 5}}\n", ":1: .*1 is no Noll index from 2 to 1000"),
        *((f"spectrum: {json.dumps(one)}\n", ":1: .*spectrum") for one in (MANY, WIDE)),  # all memory
        ("mag_j: true\n", ":1: .*mag_j is true, which is no number"),
    ],
)
def test_a_mistake_in_a_side_car_is_reported_in_one_line_with_its_place(tmp_path, text, message):
    path = tmp_path / "acquisition.yaml"
    path.write_text(text)
    with pytest.raises(InputDataError, match=rf"acquisition\.yaml{message}") as caught:
        read_sidecar(path)
    assert "\n" not in str(caught.value)


def test_keys_for_an_input_replace_single_keys_only():
    general = AcquisitionKeys(mag_j=7.0, detector={"e_per_adu": 2.0, "read_noise_e": 1.0})
    merged = general.updated(AcquisitionKeys(role="psf", detector={"read_noise_e": 4.0}))
    assert merged.flat() == {
        "mag_j": 7.0,
        "role": "psf",
        "detector.e_per_adu": 2.0,
        "detector.read_noise_e": 4.0,
    }


def test_the_keys_of_a_side_car_stand_in_the_order_of_the_class():
    """An order that is that of a set differs between processes, and so do the files that hold it."""
    given = dict(reversed(sidecar().items()))
    keys = [key.split(".")[0] for key in AcquisitionKeys.model_validate(given).flat()]
    order = list(AcquisitionKeys.model_fields)
    assert [order.index(key) for key in keys] == sorted(order.index(key) for key in keys)


def acquisition(folder, *, exposure_s: float | None = 0.1, detector: dict | None = None, **keys):
    told = {"detector": {"e_per_adu": 0.5} | (detector or {}), **keys}
    untold = ["exposure_s"] if exposure_s is None else []
    given = {} if exposure_s is None else {"exposure_s": exposure_s}
    write_sidecar(folder / "acquisition.yaml", *untold, **told, **given)
    return resolve(recording(folder), NOTHING, IRLOS).acquisition


def test_a_frame_has_as_many_reads_as_fill_its_exposure(tmp_path):
    detector = acquisition(tmp_path, detector={"read_s": 0.002, "read_noise_e": 0.8}).detector
    assert detector.reads == 50
    assert detector.read_noise_e == pytest.approx(0.8 * np.sqrt(50))


def test_sky_and_dark_current_collect_during_the_exposure(tmp_path):
    told = acquisition(tmp_path, sky_e_per_s=14.0, detector={"dark_e_per_s": 3.0})
    assert told.detector.background_e == pytest.approx(1.7)


@pytest.mark.parametrize(
    ("detector", "message"),
    [
        ({"read_s": 0.005, "coadds": 10}, "detector.coadds = 10 reads of read_s = 0.005 s do not add up"),
        ({"read_s": 0.03}, r"reads of 0.03 s do not add up to exposure_s = 0.1 \(3.333 reads\)"),
    ],
)
def test_reads_that_do_not_add_up_to_the_exposure_are_refused_in_one_line(tmp_path, detector, message):
    with pytest.raises(InputDataError, match=message) as error:
        acquisition(tmp_path, detector=detector)
    assert "\n" not in str(error.value) and "acquisition.yaml" in str(error.value)


def seeing(folder: Path, recipe: AcquisitionKeys = NOTHING, header: dict | None = None, **keys):
    """Seeing that a recording is taken to have, and the warnings."""
    write_sidecar(folder / "acquisition.yaml", *(["seeing_arcsec"] if header else []), **keys)
    resolved = resolve(recording(folder, header=header), recipe, SCALED)
    return resolved.acquisition.seeing_arcsec, resolved.warnings


def test_a_seeing_on_another_scale_is_translated_and_that_is_reported(tmp_path):
    value, warnings = seeing(tmp_path, seeing_arcsec=0.8, seeing_scale="mass_dimm")
    assert value == pytest.approx(0.62)
    assert warnings == ("rec: seeing of 0.80 arcsec by mass_dimm taken as 0.62 arcsec by SPARTA",)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"seeing_scale": "mass_dim"}, "seeing_scale = 'mass_dim' is not known .*; did you mean 'mass_dimm'"),
        ({"seeing_scale": "offset"}, r"seeing_arcsec = 0\.5 by offset would be -0\.1 by SPARTA"),
    ],
)
def test_what_makes_no_sense_is_reported_in_one_line(tmp_path, monkeypatch, keys, message):
    monkeypatch.setitem(SCALED.seeing_scales, "offset", SeeingScale(1.0, -0.6))
    with pytest.raises(InputDataError, match=message):
        seeing(tmp_path, seeing_arcsec=0.5, **keys)


def test_the_header_of_muse_has_the_monitors_seeing_and_its_table_that_of_sparta(tmp_path):
    cube, header = np.ones((2, 8, 8)), {"ESO TEL AMBI FWHM START": 0.7}
    (monitor,) = read_recordings(write_muse(tmp_path / "a.fits", cube, header=header), IRLOS)
    seen = [0.4, 0.5, 0.6, -1.0]
    (sparta,) = read_recordings(write_muse(tmp_path / "b.fits", cube, header=header, seeing=seen), IRLOS)
    (neither,) = read_recordings(write_muse(tmp_path / "c.fits", cube), IRLOS)
    assert (monitor.header["seeing_arcsec"], monitor.header["seeing_scale"]) == (0.7, "mass_dimm")
    assert (sparta.header["seeing_arcsec"], sparta.header["seeing_scale"]) == (pytest.approx(0.5), "sparta")
    assert "seeing_scale" not in neither.header


# A proposed side-car holds every key, and can be read; values follow who writes the keywords.


FILLED = {
    "role:": "role: psf",
    "spectrum:": "spectrum: [{wavelength_nm: 1600}]",
    "diversity:": "diversity: {source: none, zernike: {}}",
}


@pytest.fixture
def cube(tmp_path):
    path = tmp_path / "star.fits"
    header = fits.Header({"OBJECT": "HD 1", "EXPTIME": 0.5, "RDNOISE": -1.0})
    header["GAIN"] = (2.0, "[e-/ADU]")
    fits.PrimaryHDU(np.random.default_rng(0).poisson(50.0, (3, 16, 16)), header).writeto(path)
    return path


def test_the_template_is_valid_once_the_three_keys_are_filled_in(cube):
    text = sidecar_template(cube, load_instrument("irlos"))
    lines = [FILLED.get(line.partition(" ")[0], line) for line in text.splitlines()]
    cube.with_suffix(".yaml").write_text("\n".join(lines))
    keys = read_sidecar(cube.with_suffix(".yaml"))
    assert (keys.role, keys.target, keys.exposure_s) == ("psf", "HD 1", 0.5)
    assert keys.detector == DetectorKeys(e_per_adu=2.0)  # a read noise of -1 is none
    free = text.replace("# ", "")
    assert [
        key for key in [*AcquisitionKeys.model_fields, *DetectorKeys.model_fields] if key not in free
    ] == []


def test_the_command_writes_beside_the_file_and_replaces_nothing(cube):
    assert invoke("sidecar", str(cube)).stdout == f"{cube.with_suffix('.yaml')}\n"
    again = invoke("sidecar", str(cube))
    assert again.exit_code == 2 and "exists" in again.stderr
    assert invoke("sidecar", str(cube), "--output", "-").stdout == cube.with_suffix(".yaml").read_text()


def test_a_run_that_is_only_planned_and_a_validation_tell_all_that_side_cars_lack(cube, tmp_path):
    other = fits.getdata(cube)
    fits.writeto(tmp_path / "other.fits", other)
    (tmp_path / "other.yaml").write_text("rle: psf\nmag_j: 99\ndiversity: {zernike: {1: 3}}\n")
    invoke("sidecar", str(cube))
    options = ("diagnose", "--input", f"cube={tmp_path}")
    for result in (
        invoke("validate", *options),
        invoke("run", *options, "--output", str(tmp_path.parent / "out"), "--dry-run"),
    ):
        lines = result.stderr.splitlines()
        assert result.exit_code == 3 and len(lines) == 4
        assert [f"other.yaml:{number}:" in line for number, line in enumerate(lines[:3], 1)] == [True] * 3
        assert "star.yaml: keys 'role', 'spectrum', 'diversity' missing" in lines[3]


ESO = {"HIERARCH ESO DET DIT": 0.2, "EXPTIME": 1.0}


@pytest.mark.parametrize(
    ("cards", "planes", "key", "value", "sure"),
    [
        ({"GAIN": 139, "EGAIN": 0.34}, 1, "detector.e_per_adu", 0.34, True),
        ({"GAIN": 139}, 1, "detector.e_per_adu", 139, False),
        ({"GAIN": (2.0, "[e-/ADU] gain")}, 1, "detector.e_per_adu", 2.0, True),
        ({"GAIN": (2.0, "electrons per DN")}, 1, "detector.e_per_adu", 2.0, True),
        ({"GAIN": (2.0, "[ADU/e-]")}, 1, "detector.e_per_adu", 2.0, False),
        ({"ITIME": 0.1, "COADDS": 20}, 1, "exposure_s", 2.0, True),
        ({"ITIME": 0.1, "COADDS": 20}, 1, "detector.read_s", 0.1, True),
        ({"EXPTIME": 2.0, "COADDEXP": 0.1, "COADDS": 20}, 1, "exposure_s", 2.0, True),
        ({"EXPTIME": 2.0, "COADDS": 20}, 1, "exposure_s", 2.0, True),
        (ESO | {"HIERARCH ESO DET NDIT": 5}, 5, "exposure_s", 0.2, True),
        (ESO | {"HIERARCH ESO DET NDIT": 4}, 5, "exposure_s", 0.2, True),
        (ESO | {"HIERARCH ESO DET NDIT": 5}, 1, "detector.coadds", 5, False),
        (ESO | {"HIERARCH ESO DET NDIT": 5}, 1, "exposure_s", 1.0, False),
    ],
)
def test_a_proposal_has_the_meaning_of_its_author_or_is_doubtful(cards, planes, key, value, sure):
    header = fits.Header()
    for name, content in cards.items():
        header[name] = content
    proposed = proposals(header, planes)[key]
    assert proposed.value == pytest.approx(value) and (proposed.doubt == "") is sure


# Spectrum from filter and star. Truth: integrals over the curve, and Planck's law by astropy.


J_AND_H = [(1150, 0), (1157, 0.8), (1273, 0.8), (1280, 0), (1530, 0), (1541, 0.9), (1709, 0.9), (1720, 0)]


def test_photons_are_those_of_planck_s_law():
    nm = np.array([1000.0, 1600.0, 2300.0])
    radiance = BlackBody(4000 * u.K, scale=1 * u.W / u.m**2 / u.um / u.sr)(nm * u.nm).value * nm
    assert photons(nm, 4000) / photons(nm, 4000)[0] == pytest.approx(radiance / radiance[0], rel=1e-6)


@pytest.mark.parametrize("kelvin", [3500.0, 9600.0])
def test_three_points_per_band_have_its_photons_and_mean_wavelength(kelvin):
    points = np.array(spectrum_of(J_AND_H, kelvin, "here"))
    fine = np.linspace(1150, 1720, 100_001)
    weight = np.interp(fine, *np.array(J_AND_H, float).T) * photons(fine, kelvin)
    for low, high, own in ((1150, 1280, slice(0, 3)), (1530, 1720, slice(3, 6))):
        band = (fine > low) & (fine < high)
        assert points[own, 1].sum() == pytest.approx(weight[band].sum() / weight.sum(), rel=2e-3)
        mean = np.average(fine[band], weights=weight[band])
        assert np.average(points[own, 0], weights=points[own, 1]) == pytest.approx(mean, abs=0.2)
    assert len(points) == 6 and points[:, 1].sum() == pytest.approx(1)


@pytest.mark.parametrize(
    ("curve", "message"),
    [
        (
            J_AND_H[:-1],
            "does not cover the band: at its longest wavelength, 1709 nm, the filter still transmits 0.9",
        ),
        (J_AND_H[1:], "does not cover the band: at its shortest wavelength, 1157 nm"),
        (J_AND_H[::-1], "wavelengths should rise"),
    ],
)
def test_a_curve_that_is_none_is_refused(curve, message):
    with pytest.raises(InputDataError, match=message):
        spectrum_of(curve, 5000.0, "here")


def test_reads_make_the_exposure_where_none_is_told(tmp_path):
    told = acquisition(tmp_path, exposure_s=None, detector={"read_s": 0.004, "coadds": 250})
    assert told.exposure_s == pytest.approx(1.0)
