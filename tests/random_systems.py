"""Random descriptor systems of index 0 to 4 with rotating kernels, and what outputs tell of them.

    [I 0; 0 N] z' = [J 0; 0 I] z + f + F̃ θ,    x = Q(t) z,    rows mixed by P(t)

N is nilpotent, so z_b = −Σ Nⁱ (f_b + F̃_b θ)⁽ⁱ⁾ is known in closed form: what is observable is
found from exponentials of matrices alone, without the program's reduction.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.linalg import block_diag, expm

HORIZON = 3.0
_GAP = 1e-5  # relative singular values between this and ...
_ZERO = 1e-10  # ... this are neither: another system is drawn


def _turn(n, pairs, rates, t, order=0):
    """Rotations in the planes of some pairs of axes, or their derivative, at the time t."""
    found = np.eye(n) if order == 0 else np.zeros((n, n))
    for (i, j), w in zip(pairs, rates, strict=True):
        angle, factor = w * t + order * np.pi / 2, w**order
        c, s = factor * np.cos(angle), factor * np.sin(angle)
        found[[i, i, j, j], [i, j, i, j]] = [c, -s, s, c]
    return found


def _text(parts):
    """Σ M_k f_k(t) as rows of expressions; parts are (M_k, f_k)."""
    shape = parts[0][0].shape
    rows = [["" for _ in range(shape[1])] for _ in range(shape[0])]
    for matrix, factor in parts:
        for i, j in np.argwhere(matrix):
            rows[i][j] += f"+({float(matrix[i, j])!r})*{factor}"
    return [[entry or 0 for entry in row] for row in rows]


def _terms(n, pairs, rates, order=0):
    """The same rotations as matrices and the functions that they go with."""
    rest = np.eye(n)
    out = []
    for (i, j), w in zip(pairs, rates, strict=True):
        rest[[i, j], [i, j]] = 0.0
        c, s = np.zeros((n, n)), np.zeros((n, n))
        c[[i, j], [i, j]], s[[i, j], [j, i]] = 1.0, [-1.0, 1.0]
        names = (f"cos({w!r}*t)", f"sin({w!r}*t)")
        out += [(c, names[0]), (s, names[1])] if order == 0 else [
            (-w * c, names[1]), (w * s, names[0])
        ]
    return [(rest, "1"), *out] if order == 0 else out


def random_system(seed):
    """A plant as a mapping, and by name whether its output determines it."""
    rng = np.random.default_rng(seed)
    while True:
        plant, determined, clear = _drawn(rng, seed % 5)
        if clear:
            return plant, determined


def _drawn(rng, index):
    """One of the given index, and whether its rank is beyond doubt."""
    d, q = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    blocks = [index, int(rng.integers(1, index + 1))][: int(rng.integers(1, 3))] if index else []
    N = block_diag(*[np.diag(rng.uniform(0.5, 1.5, k - 1), 1) for k in blocks], np.zeros((0, 0)))
    a = len(N)
    n = d + a
    J = rng.normal(size=(d, d)) - 1.2 * np.eye(d)
    F = rng.normal(size=(n, q))
    C = rng.normal(size=(1, n))
    # A part that nothing else depends on, now and then: the output does not see it.
    hidden = np.append(rng.random(d) < 0.3, np.zeros(a, dtype=bool))
    J[np.ix_(~hidden[:d], hidden[:d])] = 0.0
    C[:, hidden] = 0.0
    if rng.random() < 0.5:
        C[:, d:] *= rng.random(a) < 0.4  # of the algebraic states it sees few: Assumption 1 fails
    F[:, rng.random(q) < 0.3] *= hidden[:, None]
    F[d:] *= rng.random((a, 1)) < 0.6
    vary = rng.uniform(-1.0, 1.0, size=(a, q)) * (F[d:] != 0.0)  # F̃_b = F_b + vary sin t
    order = rng.permutation(n)
    pairs = [tuple(order[2 * k : 2 * k + 2].tolist()) for k in range(int(rng.integers(1, 3)))
             if 2 * k + 1 < n]
    rates = [float(w) for w in rng.uniform(0.3, 1.5, len(pairs))]
    left = [(0, n - 1)] if n > 1 else []
    left_rates = [float(rng.uniform(0.3, 1.0))] * len(left)

    # Q⁻¹ = Qᵀ:  E = P diag(I, N) Qᵀ,  A = P (diag(J, I) Qᵀ − diag(I, N) Qᵀ'),  C Qᵀ, P F̃
    ahead, still = block_diag(np.eye(d), N), block_diag(J, np.eye(a))
    P = _terms(n, left, left_rates)
    back, slope = ([(M.T, f) for M, f in _terms(n, pairs, rates, k)] for k in (0, 1))
    tilde = [(F, "1"), (np.vstack([np.zeros((d, q)), vary]), "sin(t)")]

    def product(*factors):
        parts = factors[0]
        for factor in factors[1:]:
            parts = [(M @ other, f"{f}*{g}") for M, f in parts for other, g in factor]
        return [(M, f) for M, f in parts if M.any()] or parts[:1]

    states, unknowns = [f"x{i}" for i in range(n)], {f"k{j}": 1.0 + j for j in range(q)}
    known = rng.normal(size=(n, 1))
    plant = {
        "name": "random", "states": states, "inputs": {"u": "sin(2*t) + cos(t)"},
        "unknowns": unknowns, "outputs": ["y"],
        "E": _text(product(P, [(ahead, "1")], back)),
        "A": _text(product(P, [(still, "1")], back) + product(P, [(-ahead, "1")], slope)),
        "B": _text(product(P, [(known, "1")])), "F": _text(product(P, tilde)),
        "C": _text(product([(C, "1")], back)), "initial_state": dict.fromkeys(states, 1.0),
    }
    # z = whole (z_a(0), θ) but for what is known; O stacks the output at many times.
    drift = np.block([[J, F[:d]], [np.zeros((q, d + q))]])

    def whole(t):
        of_theta, power = np.zeros((a, q)), np.eye(a)
        for i in range(index):
            of_theta -= power @ ((F[d:] if i == 0 else 0.0) + vary * np.sin(t + i * np.pi / 2))
            power = power @ N
        return np.vstack([expm(drift * t)[:d], np.hstack([np.zeros((a, d)), of_theta])])

    O = np.vstack([C @ whole(t) for t in np.linspace(0.0, HORIZON, 200)])
    size = np.linalg.norm(O, axis=0)
    unit = np.where(size > _ZERO, size, 1.0)
    _, sigma, Vt = np.linalg.svd(O / unit)
    sigma = np.append(sigma, np.zeros(d + q))[: d + q] / max(sigma[0], 1e-300)
    clear = not ((sigma > _ZERO) & (sigma < _GAP)).any()
    kernel = Vt[int((sigma >= _GAP).sum()) :].T / unit[:, None]
    rows = np.vstack([_turn(n, pairs, rates, HORIZON) @ whole(HORIZON), np.eye(d + q)[d:]])
    size = np.maximum(np.linalg.norm(rows / unit, axis=1), _ZERO)
    part = np.linalg.norm(rows @ kernel, axis=1) / size
    return plant, dict(zip([*states, *unknowns], (part < 1e-7).tolist(), strict=True)), clear


def run_system(plant, horizon=HORIZON, **observer):
    """The run of a plant, as it comes or with an observer's settings."""
    from gpebo_cli.experiment.pipeline import run_experiment
    from gpebo_cli.model.plant import plant_from_mapping
    from gpebo_cli.settings import Settings, SolverSettings, TimeSettings

    return run_experiment(Settings(
        {"name": "ls_drem", "f0": 1e-9}, TimeSettings(0.0, horizon, 31),
        SolverSettings(max_elements=3000), {"name": "gpebo", **observer},
    ), plant_from_mapping(plant))


def largest_error(result):
    """Of what is called estimable at the end, states beside the size that they ever had."""
    found, x = result.estimation, result.simulation.states
    errors = np.concatenate([
        found.parameters[0, -1] - found.true_parameters[-1],
        (found.states[0, -1] - x[-1]) / np.maximum(1.0, np.abs(x).max(axis=0)),
    ])
    names = [*found.names, *result.system.states]
    told = [e for e, name in zip(errors, names, strict=True) if result.estimable[name] is not None]
    return float(np.abs(told).max(initial=0.0))


def main(first, last):
    """Run systems and print those of which the program says something else, or wrong numbers."""
    from gpebo_cli.errors import GpeboError

    wrong = 0
    for seed in range(first, last):
        plant, expected = random_system(seed)
        try:
            result = run_system(plant)
            told = result.estimable
            other = [name for name in expected if (told[name] is not None) != expected[name]]
            if not largest_error(result) < 1e-6:
                other.append(f"error {largest_error(result):.1e}")
        except GpeboError as error:
            other = [str(error)]
        if other:
            wrong += 1
            sys.stdout.write(f"seed {seed}, index {seed % 5}: {', '.join(other)}\n")
    sys.stdout.write(f"{last - first - wrong} of {last - first} agree\n")


if __name__ == "__main__":
    main(*map(int, (["0", *sys.argv[1:]])[-2:]))
