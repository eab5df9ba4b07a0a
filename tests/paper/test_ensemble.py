"""Samples computed in processes of their own; truth from the same function called in this process."""

import os
from dataclasses import replace

import numpy as np
import pytest
from helpers.ensemble_cases import NAMES, computed, context, die, draw, draws, object_array, refuse, threads

from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.paper.common.ensemble import _read, _work, run_samples, sample_key


@pytest.mark.slow
def test_results_stand_in_the_order_of_the_samples_and_are_what_the_function_returns(tmp_path):
    (tmp_path / "a.hold").touch()  # the first sample ends last
    samples = draws(tmp_path)
    bar = ReleasesFirst(tmp_path / "a.hold", after=len(samples) - 1)
    ctx = replace(context(tmp_path / "scratch"), progress=lambda **_: bar)
    found = run_samples(draw, samples, ctx, "draws")
    assert [one["name"] for (one,) in found] == list(NAMES)
    for (one,), sample in zip(found, samples, strict=True):
        (expected,) = draw(sample)
        assert np.allclose(one["product"], expected["product"], rtol=1e-12, atol=1e-9)
        assert one["trace"] == expected["trace"] and type(one["trace"]) is float


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


@pytest.mark.slow
def test_results_are_the_same_to_the_bit_for_any_number_of_jobs(tmp_path):
    one, three = (
        run_samples(draw, draws(tmp_path), context(tmp_path / str(jobs), jobs), "draws") for jobs in (1, 3)
    )
    for (first,), (second,) in zip(one, three, strict=True):
        assert first.keys() == second.keys()
        assert all(np.array_equal(first[name], second[name]) for name in first)


@pytest.mark.slow
def test_only_what_is_missing_is_computed_again_and_nothing_of_it_changes(tmp_path):
    ctx, samples = context(tmp_path / "scratch"), draws(tmp_path)
    before = run_samples(draw, samples[:2], ctx, "draws")
    damaged, whole = (ctx.scratch / f"{sample_key(draw, sample)}.npz" for sample in samples[:2])
    damaged.write_bytes(damaged.read_bytes()[:-50])
    assert computed(tmp_path) == ["a", "b"] and whole.is_file()
    after = run_samples(draw, samples[:3], ctx, "draws")
    assert computed(tmp_path) == ["a", "c"]
    assert np.array_equal(after[0][0]["product"], before[0][0]["product"])
    assert np.array_equal(after[1][0]["product"], before[1][0]["product"])


@pytest.mark.slow
def test_finished_samples_need_no_process_and_equal_ones_are_computed_once(tmp_path, monkeypatch):
    ctx, samples = context(tmp_path / "scratch"), draws(tmp_path, "a") * 3
    assert len(run_samples(draw, samples, ctx, "draws")) == 3 and computed(tmp_path) == ["a"]
    monkeypatch.setattr("irlos_pipe.paper.common.ensemble.in_processes", None)
    assert len(run_samples(draw, samples, ctx, "draws")) == 3
    assert run_samples(draw, [], ctx, "draws") == []


@pytest.mark.slow
def test_an_error_of_a_sample_keeps_its_kind_and_names_the_sample(tmp_path):
    samples = [{"seed": seed, "name": f"cube {seed}"} for seed in (1, 2)]
    with pytest.raises(InputDataError, match=r"^scan: sample cube 2: no star in the window$"):
        run_samples(refuse, samples, context(tmp_path, jobs=1), "scan")
    with pytest.raises(InputDataError, match=r'^scan: sample {"seed":2}: no star in the window$'):
        run_samples(refuse, [{"seed": 2}], context(tmp_path), "scan")
    assert len(list(tmp_path.glob("*.npz"))) == 1  # what was finished stays


@pytest.mark.slow
def test_a_worker_that_dies_gives_one_line_and_finished_samples_stay(tmp_path):
    samples = [{"seed": 1}, {"seed": 2}]
    with pytest.raises(IrlosError, match=r"^scan: a worker process was killed, .* run the same command"):
        run_samples(die, samples, context(tmp_path, jobs=1), "scan")
    assert [file.stem for file in tmp_path.glob("*.npz")] == [sample_key(die, samples[0])]


@pytest.mark.slow
def test_every_worker_uses_one_thread_and_this_process_keeps_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    found = run_samples(threads, range(4), context(tmp_path), "threads")
    assert {(one["torch"], one["omp"]) for (one,) in found} == {(1, "1")}
    assert os.environ["OMP_NUM_THREADS"] == "7" and "MKL_NUM_THREADS" not in os.environ


def test_what_cannot_be_stored_is_refused_by_its_name(tmp_path):
    with pytest.raises(TypeError, match="object_array: 'answer' is neither numbers nor text"):
        run_samples(object_array, [1], context(tmp_path), "objects")
    assert not list(tmp_path.iterdir())


def test_the_key_of_a_sample_depends_on_function_values_and_kinds_and_not_on_the_order_of_keys(tmp_path):
    (sample,) = draws(tmp_path, "a")
    as_dict = {"name": "a", "seed": 0, "folder": str(tmp_path)}
    turned = dict(reversed(as_dict.items()))
    assert sample_key(refuse, as_dict) == sample_key(refuse, turned)
    others = [
        sample_key(refuse, as_dict),
        sample_key(die, as_dict),
        sample_key(refuse, sample),
        sample_key(refuse, as_dict | {"seed": 1}),
        sample_key(refuse, as_dict | {"seed": np.arange(2)}),
    ]
    assert len(set(others)) == len(others)


def test_rows_come_back_with_their_kinds_and_all_digits(tmp_path):
    rows = [{"n": 3, "x": 0.1 + 0.2, "good": True, "text": "ä"}, {"x": float("nan"), "v": np.arange(3.0)}]
    _work(lambda sample: rows, None, tmp_path / "one.npz")
    first, second = _read(tmp_path / "one.npz")
    assert first == rows[0] and [type(value) for value in first.values()] == [int, float, bool, str]
    assert np.isnan(second["x"]) and np.array_equal(second["v"], rows[1]["v"])
