"""The star before and after the correction of the calibrated NCPAs (paper, Fig. "improvement").

The cube that is calibrated has the diversity; the star shown has not. The correction is what SPARTA
accepts: Noll 4–30 of the estimate, subtracted from the wavefront. Tip and tilt are the loop's.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas
from pydantic import Field

from irlos_pipe.conventions.modes import CORRECTED_NOLLS, TIP_TILT
from irlos_pipe.optics.image_quality import ring_means
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common.calibrations import DEFAULT, METHOD_NAMES, PAPER_CHOICE, VARIANTS, ObservedCube
from irlos_pipe.paper.common.scenes import star_image
from irlos_pipe.report.drawing import BLUE, GREEN, INK, ORANGE, profile_plot, svg
from irlos_pipe.report.images import BRIGHTNESS, SIGNED, log_scale, symmetric_scale

METHODS = (DEFAULT, PAPER_CHOICE)
STATES = {"before": "before", PAPER_CHOICE: "DIP global", DEFAULT: "this pipeline", "ideal": "no NCPAs"}
LOOKS = {"before": (ORANGE, "--"), PAPER_CHOICE: (GREEN, "-."), DEFAULT: (BLUE, "-"), "ideal": (INK, ":")}

LISTING = ex.Listing("stars", "Strehl ratio",
    {
        'seeing ["]': "{seeing_arcsec}", "before": "{before:.3f}", "DIP global": f"{{{PAPER_CHOICE}:.3f}}",
        "this pipeline": f"{{{DEFAULT}:.3f}}", "limit": "{ideal:.3f}", "stars": "{samples}",
    },
    caption="Strehl ratio of the averaged star at 1600 nm, Noll 4–30 corrected, limit: no NCPAs; medians.",
)  # fmt: skip


class Sizes(ex.StageConfig):
    samples: int = Field(4, ge=1, le=1000, description="stars at each seeing; the first is drawn")
    seeings_arcsec: tuple[float, ...] = Field((0.35, 1.0), description="seeings on SPARTA's scale")
    frames: int = Field(300, ge=10, le=10000, description="frames of the cube that is calibrated")
    star_frames: int = Field(100, ge=1, le=10000, description="frames of 0.1 s averaged to a star's image")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")


def samples(ctx: ex.Context) -> ex.Samples:
    """One star at one seeing; the n-th of every seeing has the same NCPAs."""
    for seeing in ctx.config.seeings_arcsec:
        name = "{seeing_arcsec:g} arcsec, star {index}"
        yield from ex.each(ctx, ctx.config.samples, name, seeing_arcsec=seeing)


def rows(star: ex.Sample) -> ex.Rows:
    """Calibrate by every method and image the star with each correction, with none, and without NCPAs."""
    sizes = star.sizes
    cube = ObservedCube.of(star.cube(star["seeing_arcsec"], sizes.frames, sizes.mag_j))
    scene, exposed = cube.scene, cube.exposed
    still_nm = {noll: value for noll, value in scene.ncpa_nm.items() if noll not in TIP_TILT}
    truth_nm = np.where(exposed.transmission > 0, exposed.mean_opd_nm, np.nan)

    def imaged(state: str, removed_nm: Mapping[int, float], wavefront_nm: np.ndarray) -> dict[str, Any]:
        ncpa_nm = {noll: value - removed_nm.get(noll, 0.0) for noll, value in still_nm.items()}
        image, strehl = star_image(scene, sizes.star_frames, ncpa_nm)
        drawn = {"image": image, "wavefront_nm": wavefront_nm}
        return {"state": state, "strehl": strehl, "pixel_scale_mas": scene.pixel_scale_mas, **drawn}

    yield imaged("before", {}, truth_nm)
    yield imaged("ideal", scene.ncpa_nm, truth_nm)
    for method in METHODS:
        calibration = cube.calibrated(VARIANTS[method])
        estimate_nm = dict(zip(calibration.nolls, calibration.zernike_nm, strict=True))
        removed_nm = {noll: estimate_nm[noll] for noll in CORRECTED_NOLLS if noll in estimate_nm}
        row = imaged(method, removed_nm, cube.wavefront_nm(calibration))
        yield row | {"pupil_nm": cube.pupil_delta_nm(calibration)}


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """Medians over the stars of a seeing; won: part of the Strehl ratio that a perfect correction gains."""

    def stars(group, seeing_arcsec):
        strehl = group.pivot(index="sample", columns="state", values="strehl")
        numbers = {"samples": len(strehl)} | {state: float(np.median(strehl[state])) for state in STATES}
        for method in METHODS:
            won = (strehl[method] - strehl.before) / (strehl.ideal - strehl.before)
            delta_nm = group.pupil_nm[group.state == method]
            numbers |= {f"{method}_won": np.median(won), f"{method}_delta_wfe_nm": np.median(delta_nm)}
        return numbers

    return {"stars": ex.grouped(rows, ["seeing_arcsec"], stars)}


def checks(tables: ex.Tables) -> list[ex.Check]:
    """Every correction sharpens the star, the default's not less than the paper's choice."""
    stars, gains = tables["stars"], []
    for row in stars.to_dict("records"):
        for method in METHODS:
            name = f"gain in Strehl ratio by {METHOD_NAMES[method]}, {row['seeing_arcsec']:g} arcsec"
            text = f"from {row['before']:.3f} to {row[method]:.3f}, median of {row['samples']} stars"
            gains.append(ex.check(name, row[method] / row["before"], text, low=1.0))
    return gains + ex.checked(
        stars, "Strehl ratio by the default over that by DIP global, {seeing_arcsec:g} arcsec",
        lambda row: row[DEFAULT] / row[PAPER_CHOICE],
        f"{{{DEFAULT}:.3f}} and {{{PAPER_CHOICE}:.3f}}", low=1.0,
    )  # fmt: skip


def arrays(rows: ex.Frame, ctx: ex.Context) -> dict[str, ex.Quantity]:
    """Images and wavefronts of the first star of every seeing."""
    found = {}
    for row in rows.drop_duplicates(["seeing_arcsec", "state"]).itertuples():
        name = f"{row.seeing_arcsec:g}/{row.state}"
        found[f"{name}/image"] = ex.Quantity(row.image, "1/px", "averaged star, part of the photons")
        found[f"{name}/wavefront_nm"] = ex.Quantity(row.wavefront_nm, "nm", "wavefront, true or estimated")
    return found


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """Images, wavefronts and profiles of the first star of every seeing."""
    scale_mas = float(drawn.array("rows/pixel_scale_mas")[0])
    found: ex.Blocks = []
    for seeing in drawn.tables["stars"].seeing_arcsec:
        images = {state: drawn.array(f"{seeing:g}/{state}/image") for state in STATES}
        maps = {state: drawn.array(f"{seeing:g}/{state}/wavefront_nm") for state in ("before", *METHODS)}
        name, at = f"{seeing:g}".replace(".", "-"), f'at {seeing:g}"'
        profiles: dict[str, Any] = {}
        for state, image in images.items():
            radius_px, mean = ring_means(image, ((image.shape[0] - 1) / 2, (image.shape[1] - 1) / 2))
            profiles[STATES[state]] = (radius_px * scale_mas, mean, *LOOKS[state])
        stars = _stars(f"gain-stars-{name}", images, scale_mas)
        left = _wavefronts(f"gain-wavefronts-{name}", maps)
        labels = ("mas", "photons per pixel, part of all")
        drawing = profile_plot(f"gain-profiles-{name}", profiles, labels)
        found += [
            ex.Figure(stars, f"Averaged star {at}", "One logarithmic scale.", "full"),
            ex.Figure(left, f"Wavefronts {at}", "Averaged over time, tip and tilt included.", "full"),
            ex.Figure(drawing, f"Radial profiles {at}"),
        ]
    return found


def _stars(name: str, images: Mapping[str, np.ndarray], scale_mas: float) -> Markup:
    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, len(images))
        for axes, (state, image) in zip(panels, images.items(), strict=True):
            half, scale = image.shape[1] / 2 * scale_mas, log_scale(*images.values())
            shown = axes.imshow(image, BRIGHTNESS, scale, origin="lower", extent=(-half, half, -half, half))
            axes.set(title=STATES[state], xlabel="x [mas]")
            axes.grid(False)
        panels[0].set_ylabel("y [mas]")
        figure.colorbar(shown, ax=panels, label="photons per pixel, part of all", shrink=0.75)

    return svg(name, (9.5, 2.7), draw)


def _wavefronts(name: str, maps: Mapping[str, np.ndarray]) -> Markup:
    truth, shown_maps = maps["before"], {"true": maps["before"]}
    for method in METHODS:
        shown_maps |= {STATES[method]: maps[method], f"true − {STATES[method]}": truth - maps[method]}
    scale = symmetric_scale(float(np.nanpercentile(np.abs(truth), 99)))

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, len(shown_maps))
        for axes, (title, values) in zip(panels, shown_maps.items(), strict=True):
            shown = axes.imshow(values - np.nanmean(values), SIGNED, scale, origin="lower")
            axes.set(title=f"{title}\n{np.nanstd(values):.0f} nm RMS", xticks=[], yticks=[])
            axes.set_frame_on(False)
        figure.colorbar(shown, ax=panels, label="nm", shrink=0.75)

    return svg(name, (9.5, 2.4), draw)


EXPERIMENT = ex.Experiment(
    "correction_gain", 3, Sizes, "Star before and after the correction",
    samples, rows, tables, checks, [LISTING], figures,
    "Strehl ratio at 1600 nm without diversity, Noll 4–30 corrected.", "stars", arrays,
)  # fmt: skip
