"""Samples computed in processes of their own; truth from the same function called in this process."""

import os
from dataclasses import replace

import numpy as np
import pytest
from helpers.ensemble_cases import NAMES, computed, context, die, draw, draws, refuse, threads

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.paper.common.ensemble import _read, _work, run_samples, sample_key

pytestmark = pytest.mark.slow


class ReleasesFirst:
    """A progress bar that lets the held sample go when all others are done."""

    def __init__(self, hold, after):
        self.hold, self.after, self.count = hold, after, 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def update(self, count):
        self.count += count
        if self.count == self.after:
            self.hold.unlink()


def test_results_stand_in_the_order_of_the_samples_and_are_the_same_for_any_number_of_jobs(tmp_path):
    (tmp_path / "a.hold").touch()  # the first sample ends last
    samples = draws(tmp_path)
    bar = ReleasesFirst(tmp_path / "a.hold", after=len(samples) - 1)
    ctx = replace(context(tmp_path / "scratch"), progress=lambda **_: bar)
    found = run_samples(draw, samples, ctx, "draws")
    assert [one["name"] for (one,) in found] == list(NAMES)
    others = run_samples(draw, samples, context(tmp_path / "one", jobs=1), "draws")
    for (one,), (other,), sample in zip(found, others, samples, strict=True):
        (expected,) = draw(sample)
        assert np.allclose(one["product"], expected["product"], rtol=1e-12, atol=1e-9)
        assert one["trace"] == expected["trace"] and type(one["trace"]) is float
        assert np.array_equal(one["product"], other["product"])


def test_only_what_is_missing_is_computed_again_and_nothing_of_it_changes(tmp_path, monkeypatch):
    ctx, samples = context(tmp_path / "scratch"), draws(tmp_path)
    before = run_samples(draw, samples[:2], ctx, "draws")
    damaged, whole = (ctx.scratch / f"{sample_key(draw, sample)}.npz" for sample in samples[:2])
    damaged.write_bytes(damaged.read_bytes()[:-50])
    assert computed(tmp_path) == ["a", "b"] and whole.is_file()
    after = run_samples(draw, [*samples[:3], samples[0]], ctx, "draws")
    assert computed(tmp_path) == ["a", "c"] and len(after) == 4
    for (one,), (other,) in zip(before, after[:2], strict=True):
        assert np.array_equal(one["product"], other["product"])
    monkeypatch.setattr("irlos_pipe.paper.common.ensemble.in_processes", None)  # which none needs any more
    assert len(run_samples(draw, samples[:3], ctx, "draws")) == 3
    assert run_samples(draw, [], ctx, "draws") == []


def test_an_error_of_a_sample_keeps_its_kind_and_names_the_sample(tmp_path):
    with pytest.raises(InputDataError, match=r"^scan: sample c: no star in the window$"):
        run_samples(refuse, draws(tmp_path)[1:3], context(tmp_path, jobs=1), "scan")
    assert len(list(tmp_path.glob("*.npz"))) == 1  # what was finished stays


def test_every_worker_uses_one_thread_and_this_process_keeps_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    found = run_samples(threads, draws(tmp_path), context(tmp_path), "threads")
    assert {(one["torch"], one["omp"]) for (one,) in found} == {(1, "1")}
    assert os.environ["OMP_NUM_THREADS"] == "7" and "MKL_NUM_THREADS" not in os.environ


def test_the_key_of_a_sample_depends_on_function_values_and_kinds_and_not_on_the_order_of_keys(tmp_path):
    (sample,) = draws(tmp_path, "a")
    as_dict = {"name": "a", "seed": 0, "folder": str(tmp_path)}
    assert sample_key(refuse, as_dict) == sample_key(refuse, dict(reversed(as_dict.items())))
    changed = [as_dict, sample, as_dict | {"seed": 1}, as_dict | {"seed": np.arange(2)}]
    keys = {sample_key(die, as_dict), *(sample_key(refuse, one) for one in changed)}
    assert len(keys) == 5


def test_rows_come_back_with_their_kinds_and_all_digits(tmp_path):
    rows = [{"n": 3, "x": 0.1 + 0.2, "good": True, "text": "ä"}, {"x": float("nan"), "v": np.arange(3.0)}]
    _work(lambda sample: rows, None, tmp_path / "one.npz")
    first, second = _read(tmp_path / "one.npz")
    assert first == rows[0] and [type(value) for value in first.values()] == [int, float, bool, str]
    assert np.isnan(second["x"]) and np.array_equal(second["v"], rows[1]["v"])
