"""Whether an export of `Focus.measure` would be faster: it next to its arithmetic in operators of PyTorch.

What is exported does less, and so has the better of it: it fits the highest maximum of the scan only, by a
fixed number of evaluations without a test of convergence or shorter steps, in single precision throughout,
and of the verdict it has nothing but error and χ²/ν.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
import torch
from threadpoolctl import threadpool_limits

from benchmarks.focus_latency import NOISE, WINDOW, Times, prepared, timed
from irlos_pipe.estimate.focus.photon_fit import FocusScan
from irlos_pipe.estimate.focus.sensor import Focus
from irlos_pipe.optics.focus_table import FocusImages

EVALUATIONS = 4  # of the image and its derivatives, as many as `Focus.measure` makes on average
BLOCK = 200

Kind = Callable[[np.ndarray], object]


class Evaluated(torch.nn.Module):
    """`FocusImages` in operators of PyTorch: ``(3,)`` to image and derivatives, ``(4, pixels)``."""

    def __init__(self, images: FocusImages):
        super().__init__()
        for name in ("_table", "_orders", "_rate", "_series"):
            self.register_buffer(name[1:], torch.as_tensor(getattr(images, name)))
        self.window, self.shape = images.window, images._shape
        self.middle, self.half = float(images._middle_nm), float(images._half_nm)
        for name, pixels, samples in zip(("rows", "columns"), self.window, self.shape, strict=True):
            first = images._longer - pixels
            index = first + torch.arange(pixels)[:, None] + torch.arange(samples)
            self.register_buffer(name, index)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the unit-flux image and its slopes at tip, tilt and focus `x`."""
        angle = torch.acos((x[2] - self.middle) / self.half)
        multiples = angle * self.orders
        steepness = self.orders * multiples.sin() / (angle.sin() * self.half)
        weights = torch.stack([multiples.cos(), steepness]).float()
        image, slope = (weights @ self.table).view(2, *self.shape)
        phase = x[:2, None] * self.rate
        kernels = torch.cat([phase.cos(), phase.sin()], 1).float() @ self.series
        along_x, along_y = kernels.view(2, 2, -1)
        (rows, steeper_rows), (columns, steeper_columns) = along_y[:, self.rows], along_x[:, self.columns]
        narrow = image @ columns.mT
        parts = [
            rows @ narrow,
            rows @ (image @ steeper_columns.mT),
            steeper_rows @ narrow,
            rows @ (slope @ columns.mT),
        ]
        return torch.stack(parts).flatten(1)


class Fitted(torch.nn.Module):
    """Scan and fit of one image ``(rows, columns)``, float32: to defocus, its error and χ²/ν."""

    def __init__(self, sensor: Focus):
        super().__init__()
        scan: FocusScan = sensor._scan
        self.images = Evaluated(sensor._images)
        self.register_buffer("spectra", torch.as_tensor(scan._spectra))
        self.register_buffer("to_rows", torch.as_tensor(scan._to_rows))
        self.register_buffer("to_columns", torch.as_tensor(scan._to_columns))
        self.register_buffer("nodes_nm", torch.as_tensor(scan._focus_nm))
        self.register_buffer("shifts_nm", torch.as_tensor(scan._shifts * scan._pixel_nm))
        self.register_buffer("limits", torch.as_tensor(sensor._images.limits_nm))
        self.register_buffer("kept_y", torch.as_tensor(np.flatnonzero(scan._kept[0])))
        self.register_buffer("kept_x", torch.as_tensor(np.flatnonzero(scan._kept[1])))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the three numbers."""
        flat, x = image.flatten(), self._start(image)
        unit = self.images(x)[0]
        count = unit.new_full((), unit.numel())
        normal = torch.stack([unit @ unit, unit.sum(), unit.sum(), count]).view(2, 2)
        light = torch.linalg.solve(normal, torch.stack([unit @ flat, flat.sum()]))
        x = torch.cat([x, light.double()])
        for _ in range(EVALUATIONS - 1):
            x, fisher, chi2 = self._scored(x, flat)
        return torch.stack([x[2], torch.linalg.inv(fisher)[2, 2].sqrt(), chi2])

    def _start(self, image: torch.Tensor) -> torch.Tensor:
        spectrum = torch.fft.rfft2(image)[self.kept_y][:, self.kept_x]
        spectrum = torch.cat([torch.zeros(1, dtype=spectrum.dtype), spectrum.flatten()[1:]]).view_as(spectrum)
        along_x = (self.spectra * spectrum) @ self.to_columns
        correlation = (self.to_rows @ along_x).real
        best = correlation.flatten().argmax()
        shifts = len(self.shifts_nm)
        node, place = best // shifts**2, best % shifts**2
        start = [self.shifts_nm[place % shifts], self.shifts_nm[place // shifts], self.nodes_nm[node]]
        return torch.stack(start)

    def _scored(self, x: torch.Tensor, flat: torch.Tensor):
        parts = self.images(x[:3])
        flux = x[3].float()
        model = flux * parts[0] + x[4].float()
        weight = 1 / (model.clamp_min(0) * NOISE.excess_noise_factor + float(NOISE.floor_e2))
        residual = flat - model
        slopes = torch.cat([flux * parts[1:], parts[:1], torch.ones_like(parts[:1])])
        weighted = slopes * weight
        fisher = (weighted @ slopes.mT).double()
        scale = fisher.diagonal().rsqrt()
        scaled, gradient = fisher * scale * scale[:, None], (weighted @ residual).double() * scale
        moved = x + torch.linalg.solve(scaled, gradient) * scale
        bounded = torch.minimum(torch.maximum(moved[:3], self.limits[0]), self.limits[1])
        chi2 = (residual * residual) @ weight / (flat.numel() - 5)
        return torch.cat([bounded, moved[3:]]), fisher, chi2.double()


@click.command()
@click.option("--calls", default=4000, show_default=True, help="Of each.")
def main(calls: int) -> None:
    """Print processor and wall time of every way, and by how much its defocus differs."""
    torch.set_num_threads(1)
    with threadpool_limits(1), torch.inference_mode():
        model, images_e = prepared()
        sensor = Focus(model, np.ones(WINDOW, bool), NOISE)
        ways = {"Focus.measure": sensor.measure, **exported(Fitted(sensor).eval(), images_e[0])}
        print(f"{'':<24}{'calls':>8}{'wall p50':>10}{'p99':>10}{'CPU p50':>10}{'p99':>10}   [ms]")
        parts: dict[str, list[Times]] = {name: [] for name in ways}
        for _ in range(max(1, calls // BLOCK)):
            for name, way in ways.items():
                parts[name].append(timed(way, images_e, BLOCK))
        for name, way in ways.items():
            apart = [abs(float(way(one)[0]) - sensor.measure(one)[0]) for one in images_e]
            print(Times.joined(parts[name]).line(name), f"  {max(apart):.2g} nm from Focus.measure")


def exported(fit: Fitted, image_e: np.ndarray) -> dict[str, Kind]:
    """Return the ways to call an exported fit."""
    example = (torch.as_tensor(image_e, dtype=torch.float32),)
    program = torch.export.export(fit, example)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        package = str(Path(folder) / "focus.pt2")
        torch._inductor.aoti_compile_and_package(program, package_path=package)
        compiled = torch._inductor.aoti_load_package(package)
    print(f"compiled in {time.process_time() - began:.0f} s, and the time of the C++ compiler")
    script = torch.jit.optimize_for_inference(torch.jit.freeze(torch.jit.trace(fit, example)))
    kinds = {"PyTorch, eager": fit, "TorchScript": script, "torch.export, compiled": compiled}

    def called(kind: Callable) -> Kind:
        return lambda image: kind(torch.as_tensor(image, dtype=torch.float32))

    return {name: called(kind) for name, kind in kinds.items()}


if __name__ == "__main__":
    main()
