"""Where the time of a fit goes, and how far it is from the floor.

Every operator that PyTorch dispatches is timed (processor time) and put into a group. The floor is the
number of floating-point operations in products of single-precision matrices over the rate at which this
machine multiplies large ones: what the same number of evaluations would cost if nothing but those were done.
"""

from __future__ import annotations

import time
from collections import defaultdict

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.cases import prepared_lift
from benchmarks.inputs import Inputs, stopwatch
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.numerics.parallel import workers

PRODUCTS = ("mm", "bmm", "addmm", "baddbmm")
COMPLEX_PRODUCTS, REAL_PRODUCTS, DOUBLE_PRODUCTS, FFT, SOLVES, REST = (
    "complex products (OTF to pixels)",
    "float32 products (matrix DFT, modes, pixels)",
    "float64 products (normal equations)",
    "FFT (OTF factors)",
    "linear solves",
    "elementwise and copies",
)
PYTHON = "set-up of the model, Python, dispatch"
FLOPS = {COMPLEX_PRODUCTS: 8.0, REAL_PRODUCTS: 2.0}  # operations per product of two elements and its sum
RATE_SIZE, RATE_REPEATS = 1024, 10  # size of the product that measures the processor's rate, and repetitions
RAMP_FRAMES = 42


class OperatorTimes(TorchDispatchMode):
    """Time of every dispatched operator, by group; `flops` of all products of single-precision matrices."""

    def __init__(self):
        super().__init__()
        self.seconds: dict[str, float] = defaultdict(float)
        self.flops = 0.0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        began = time.process_time()
        result = func(*args, **(kwargs or {}))
        group = _group(func.overloadpacket.__name__, args)
        self.seconds[group] += time.process_time() - began
        if group in FLOPS:
            self.flops += FLOPS[group] * result.numel() * args[-2].shape[-1]
        return result


def measure_breakdown(inputs: Inputs, frames: int) -> dict:
    """Shares of the groups for `dip_global` and LIFT, and the floor of each."""
    options = CalibrationOptions("dip_global", prior=inputs.prior)
    some = inputs.calibration_frames(frames)
    with workers(1):
        rate = product_rate_flops()
        return {
            "gflops": rate / 1e9,
            "dip_global": _profile(lambda: calibrate(some, inputs.settings, options), rate),
            "lift": _profile(prepared_lift(inputs, RAMP_FRAMES, with_halo=True), rate),
        }


def product_rate_flops() -> float:
    """Best rate of a large single-precision matrix product on one thread [operations/s]."""
    left, right = torch.randn(2, RATE_SIZE, RATE_SIZE)
    times_s = []
    for _ in range(RATE_REPEATS):
        began = time.process_time()
        left @ right
        times_s.append(time.process_time() - began)
    return FLOPS[REAL_PRODUCTS] * RATE_SIZE**3 / min(times_s)


def _profile(fit, rate: float) -> dict:
    """Shares of an undisturbed run; timing every operator slows the Python between them down."""
    fit()  # libraries start up
    with stopwatch() as undisturbed:
        fit()
    with OperatorTimes() as operators:
        fit()
    total_s = undisturbed.cpu_s
    shares = {group: seconds / total_s for group, seconds in operators.seconds.items()}
    shares[PYTHON] = max(0.0, 1 - sum(shares.values()))
    floor_s = operators.flops / rate
    return {"seconds": total_s, "shares": shares, "floor_s": floor_s, "over_floor": total_s / floor_s}


def _group(name: str, args) -> str:
    if name.startswith(("_fft", "fft")):
        return FFT
    if "linalg" in name or name.startswith(("_linalg", "lu_")):
        return SOLVES
    if name not in PRODUCTS:
        return REST
    if args[-1].is_complex():
        return COMPLEX_PRODUCTS
    return DOUBLE_PRODUCTS if args[-1].dtype == torch.float64 else REAL_PRODUCTS
