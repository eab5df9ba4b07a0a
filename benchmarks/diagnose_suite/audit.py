"""How far Laplace's method holds: evidence and errors of what a diagnosis found, by importance sampling.

``python -m benchmarks.diagnose_suite.audit`` hides effects as the suite does, beside mild errors, and takes
the posterior with which `diagnose` ends. The parameters of one effect are drawn from Student's law about
their optimum, with their covariance; at each draw the image is that of the whole model, and all else, modes
as well, follows linearly and is integrated out. The mean weight says by how much the evidence differs from
that of Laplace, the weighted draws what the errors are. Posteriors that are far from Gaussian in everything
else, and other minima, are not seen.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import click
import numpy as np
import torch
from scipy.special import logsumexp
from scipy.stats import multivariate_t

from benchmarks import harness
from benchmarks.diagnose_suite.cases import SINGLE, Case, all_cases
from benchmarks.diagnose_suite.making import make_case
from benchmarks.diagnose_suite.working import diagnosed, key_of
from benchmarks.harness import Outcome, Suite
from irlos_pipe.diagnosis.final import Final
from irlos_pipe.diagnosis.posterior import Laplace

SEED = 602214076  # of the reported audit
DRAWS, FREEDOM = 300, 5.0  # of Student's law, whose tails are longer than those of what is drawn
HEAD = ("case", "effect", "parameters", "ln Z sampled − Laplace", "shift of the mean [σ]", "σ over Laplace's",
        "effective draws")  # fmt: skip


def audited(laplace: Laplace, label: str, rng: np.random.Generator) -> dict[str, float]:
    """Compare Laplace's method with importance sampling for the parameters of the effect `label`.

    Returns the difference of ln Z, the largest shift of a mean in its σ, the ratio of σ that is farthest from
    one, and the effective number of draws.
    """
    posterior, size = laplace.posterior, laplace.x.shape[1]
    own = laplace.fitted.columns_of(label)
    rest = [column for column in range(size) if column not in own]
    design = posterior.covariance.whiten(laplace.columns[rest].mT)
    factor = torch.linalg.cholesky(laplace.hessian[rest][:, rest])
    mean, covariance = laplace.x[0, own].numpy(), laplace.covariance[own][:, own].numpy()
    sigma = np.sqrt(np.diag(covariance))
    correlation = (covariance + covariance.T) / (2 * np.outer(sigma, sigma))

    def log_density(values: np.ndarray) -> float:
        """Of the effect's parameters, everything else integrated out, but for a constant."""
        x = laplace.x.clone()
        x[0, own] = torch.as_tensor(values)
        if bool(((x < posterior.exact.lower) | (x > posterior.exact.upper)).any()):
            return -math.inf
        left, half = posterior.left(x)
        force = design.mT @ left - (posterior.prior_precision * (x[0] - posterior.prior_mean))[rest]
        ahead = torch.linalg.solve_triangular(factor, force[:, None], upper=False)
        return float(0.5 * (ahead**2).sum()) - half

    proposal = multivariate_t(np.zeros(len(own)), correlation * (FREEDOM - 2) / FREEDOM, FREEDOM, seed=rng)
    draws = proposal.rvs(DRAWS).reshape(DRAWS, len(own))  # in σ from the optimum
    log_weights = np.array([log_density(mean + sigma * one) for one in draws]) - log_density(mean)
    log_weights -= proposal.logpdf(draws)
    log_weights -= 0.5 * (np.linalg.slogdet(correlation)[1] + len(own) * math.log(2 * math.pi))
    weights = np.exp(log_weights - logsumexp(log_weights))
    shifts = weights @ draws
    ratios = np.sqrt(weights @ (draws - shifts) ** 2)
    return {
        "log_evidence": float(logsumexp(log_weights) - math.log(DRAWS)),
        "shift": float(np.abs(shifts).max()),
        "ratio": float(ratios[np.abs(np.log(ratios)).argmax()]),
        "effective": float(1 / (weights**2).sum()),
        "parameters": len(own),
    }


@contextmanager
def last_posteriors() -> Iterator[list[Laplace]]:
    """The posteriors with which searches end that are made inside."""
    found: list[Laplace] = []
    named = Final.named

    def seen(final: Final, *rest):
        found.append(final.laplace)
        return named(final, *rest)

    with patch.object(Final, "named", seen):
        yield found


def outcome_of(case: Case, output: Path) -> Outcome:
    """Simulate a case, diagnose it, and audit what is hidden and every second image of the last posterior."""
    data, run = (output / part / case.name for part in ("data", "runs"))
    for leftover in (data, run):
        shutil.rmtree(leftover, ignore_errors=True)
    truth = make_case(case, data, output / "truth")
    with last_posteriors() as found:
        diagnosed(case, data, run, case.model_effects)
    rows, rng = {}, np.random.default_rng(case.seed)
    for laplace in found:
        for label in laplace.fitted.problem.effects.labels:
            effect = laplace.fitted.effect(label)
            if effect.parameters and (effect.name in case.effects or effect.base.copies_star):
                rows[label] = audited(laplace, label, rng)
    return {"case": case.name, "truth": {"suite_seed": truth["suite_seed"]}, "audit": rows}


def report(outcomes: Sequence[Outcome], broken: object, output: Path) -> str:
    """Return a table with a row for every effect."""
    rows = []
    for one in outcomes:
        for label, row in one["audit"].items():
            numbers = (f"{row['log_evidence']:+.1f}", f"{row['shift']:.2f}", f"{row['ratio']:.2f}")
            rows.append((one["case"], label, f"{row['parameters']}", *numbers, f"{row['effective']:.0f}"))
    return harness.markdown(HEAD, rows)


SUITE = Suite(outcome_of, key_of, report, inside="audits")


@click.command()
@harness.options(SEED)
def main(seed: int, **how) -> None:
    """Sample the posteriors of the suite's single effects beside mild errors."""
    cases = [one for one in all_cases(seed, dirty=True) if one.kind == SINGLE and one.dirty]
    harness.run(SUITE, cases, **how)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.diagnose_suite.audit")
