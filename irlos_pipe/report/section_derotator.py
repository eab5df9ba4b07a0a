"""Section on the derotator test: maps at every angle, what turns and what does not."""

import math

import numpy as np

from irlos_pipe.product.results import StageResults
from irlos_pipe.report.content import Figure, Section, Stack, Table, Width
from irlos_pipe.report.images import common_limit_nm, wavefront_grid
from irlos_pipe.report.run_data import RunData, StageData
from irlos_pipe.report.text import number, plural, with_error
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.derotator import DerotatorResults

FEW_COLUMNS = 3  # angles up to which a figure is narrow
ROWS = {
    "measured_nm": ("as measured", "As measured: on the detector"),
    "turned_back_nm": (
        "turned back",
        "turned back: in the frame before the derotator, where what turns stands still",
    ),
    "residual_nm": ("residual", "residual: measured minus the two parts"),
}
PARTS = {
    "rotating": ("turns with the derotator", "as at angle 0"),
    "fixed": ("does not turn", "behind the derotator"),
    "unsplit": ("cannot be split", "symmetric modes: sum of both"),
}
Series = StageData[DerotatorResults]


def derotator_section(run: RunData) -> Section:
    of = run.of(DerotatorResults)
    if not of.results.parts:
        blocks = of.blocks(_maps, lambda of: Stack([_angles(of)]))
    else:
        blocks = of.blocks(
            _maps,
            _parts_figure,
            lambda of: Stack([_parts(of), _consistency(of)]),
            lambda of: Stack([_angles(of), _coefficients(of)]),
        )
    return Section(of.stage, "Derotator test", _lead(of.results), blocks)


def _lead(results: DerotatorResults) -> str:
    if not results.parts:
        return (
            f"Nothing split: {results.reason}. What turns with the derotator shows only in recordings "
            "of two or more angles."
        )
    parts, cubes = results.parts, plural(len(results.cubes), "cube")
    rotating, fixed = (number(parts[name].rms_nm, ".0f", "nm") for name in ("rotating", "fixed"))
    return f"{rotating} RMS turn with the derotator, {fixed} do not: {cubes}, each calibrated by itself."


def _maps(of: Series) -> list[Figure]:
    calibrate = of.run.of(CalibrateResults)
    names = [f"cubes/{cube.name}/mean_image_e" for cube in of.results.cubes]
    images = [calibrate[name] for name in names if name in calibrate.arrays]
    stackable = len({image.shape for image in images}) == 1 and len(images) == len(names)
    title = "Wavefront at every angle"
    return maps_figure(of.run, of.stage, title, np.stack(images) if stackable else None)


def maps_figure(
    run: RunData, stage: str, title: str, images: np.ndarray | None = None, prefix: str = ""
) -> list[Figure]:
    """Draw all angles in a row: image, estimate, estimate turned back, and what the parts leave of it.

    The `images` have shape (angles, rows, columns); `prefix` begins the names of the stage's arrays.
    """
    of = StageData(run, stage, StageResults())
    found = {name: f"{prefix}maps/{name}" for name in ROWS if f"{prefix}maps/{name}" in of.arrays}
    rows = {ROWS[name][0]: of[stored] for name, stored in found.items()}
    if not rows:
        return []
    titles = [f"{angle:g}°" for angle in of[f"{prefix}angle_deg"]]
    name = f"{stage}-{prefix}angles".replace("/", "-").replace("_", "-")
    drawing = wavefront_grid(name, titles, rows, common_limit_nm(*rows.values()), images)
    caption = "; ".join(ROWS[name][1] for name in found) + ". One scale; without tip and tilt."
    few: Width = "third" if len(titles) == 1 else "half"
    return [Figure(drawing, title, caption, few if len(titles) <= FEW_COLUMNS else "full")]


def _parts_figure(of: Series) -> Figure:
    parts, maps = of.results.parts or {}, np.stack([of[f"maps/{name}_nm"] for name in PARTS])
    titles = [f"{text}\n{number(parts[name].rms_nm, '.0f', 'nm RMS')}" for name, (text, _) in PARTS.items()]
    drawing = wavefront_grid("derotator-parts", titles, {"": maps}, common_limit_nm(maps))
    return Figure(drawing, "Parts of the wavefront", "The turning part as at angle 0.")


def _parts(of: Series) -> Table:
    results = of.results
    sense = (
        f"Sense of rotation: {results.sense} (χ² of the other sense {number(results.delta_chi2, '+.0f')}). "
        f"χ²/ν of the split {number(results.chi2_nu, '.2f')} for {results.freedom} degrees of freedom, "
        "against the errors of the single estimates."
    )
    rows = [
        (*PARTS[name], number(part.rms_nm), number(part.noise_nm), str(len(part.zernike_nm)))
        for name, part in (results.parts or {}).items()
    ]
    return Table(("part", "", "RMS [nm]", "of which errors [nm]", "modes"), rows, "Parts", sense)


def _consistency(of: Series) -> Table:
    found = of.results.consistency
    rows = [
        ("as measured", number(found.measured_nm)),
        ("turned back", number(found.turned_back_nm)),
        ("turned back, without the part that does not turn", number(found.without_fixed_nm)),
        ("expected from the errors of the estimates", number(found.expected_nm)),
    ]
    return Table(("difference between two angles", "mean RMS [nm]"), rows, "Consistency")


def _angles(of: Series) -> Table:
    results, measured = of.results, of.results.measured_nm
    left = results.residual_nm or [math.nan] * len(measured)
    angles = of["angle_deg"] if "angle_deg" in of.arrays else np.zeros(0)
    rows = [
        (cube.name, f"{angle:g}°", number(all_), number(rest))
        for cube, angle, all_, rest in zip(results.cubes, angles, measured, left, strict=True)
    ]
    columns = ("recording", "angle", "RMS [nm]", "residual [nm]")
    return Table(columns, rows, "Angles", "RMS over the disc, without tip and tilt.")


def _coefficients(of: Series) -> Table:
    parts = (of.results.parts or {}).items()
    nolls = sorted({noll for _, part in parts for noll in part.zernike_nm})
    rows = [
        (
            str(noll),
            *(with_error(part.zernike_nm.get(noll), part.sigma_nm.get(noll), "+.1f") for _, part in parts),
        )
        for noll in nolls
    ]
    columns = ("Noll", *(f"{PARTS[name][0]} [nm]" for name, _ in parts))
    return Table(columns, rows, "Coefficients of the parts", folded=True)
