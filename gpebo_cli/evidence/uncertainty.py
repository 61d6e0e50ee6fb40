"""What noise does to an estimate: one standard deviation, without any seeds.

ψ contains no noise, so the errors of everything between the samples of u and y and the estimates
are linear in those samples' errors (theory 12). With the errors ζ of the observer and s of the
estimator, and e that of the last sample, or the straight line from it to the next one's,

    [ζ; s]' = 𝔽 [ζ; s] + 𝔹 e,      δη̂ = C s,      δx̂ = gain C s + X ζ + W e.

A factor L of the covariance, L Lᵀ = cov [ζ; s; e], e both of them, goes from sample to sample by
orthogonal transformations: no variance can become negative, whatever the rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from gpebo_cli.evidence.groups import Groups, grouped
from gpebo_cli.evidence.knowledge import Knowledge
from gpebo_cli.kernels import elements
from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.model.expressions import among
from gpebo_cli.numerics.linalg import transpose, triangular
from gpebo_cli.numerics.mesh import Mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.rows import Rows
from gpebo_cli.regression.errors import ErrorRecursion, ErrorsAt, ErrorSteps, ErrorSystem
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import ExtensionState, Reset
from gpebo_cli.regression.samples import SampledRegression, integrating

_STAGES = 5  # order 9: a deviation needs three digits, and elements end at the samples
_ELEMENTS = 200  # about so many at least
_MOST_PARTS = 8
# Behind a start laws may go as a power of the time since then.
_SINCE = 24  # parts at least of that time
_HALVINGS = 8  # of the first row there
_SHORTEST = 1e-12  # of the times: where an element is shorter, its nodes are rounding
_LONGER = 3.0  # times as long as the element before it is each one in a layer behind a sample
_FASTEST = 0.1 / float(np.finfo(float).eps)  # rates times the horizon: their rounding moves s
_LOOKED = 16  # elements, about, in which rates are looked at
_CHUNK = 1 << 22  # numbers in the systems that are solved at once
_TIMES = 2001  # at which the size of the errors of Y is looked at
_LEFT = 1e-3  # share of the noise in Y that a fit has to leave before its level is estimated
_AGREE = 0.01  # of a deviation, if groups of half the size make it: the rest is a third of that
_GROUPS = 2000  # of samples, by which many of them are replaced at first
_PER_ELAPSED = 64  # groups at least, since the start, at first
_BESIDE = 8  # errors that stand beside each other in a factor
_ROWS = 1 << 15  # that are looked at at once
_STIFF = 1e12  # rates times steps, from which on rows count alike
_SINGULAR = 1e-12  # share of the largest eigenvalue of G below which a direction is not fitted


def deviations(
    observer: ErrorsAt, estimator: ErrorsAt, gain: Array, edges: Array, rows: Rows,
    variances: Array, t: Array, starts: Array | None = None,
    resets: Sequence[tuple[float, Array]] = (),
) -> tuple[Array, Array]:
    """One standard deviation of η̂ (M, p) and of x̂ (M, n) at the times t (M,), ascending.

    ``observer`` takes errors of [u; y] to those of Y and of the state's offset, ``estimator`` those
    of Y to those of η̂; the gain is that of x = offset + gain η (M, n, p). ψ is smooth between
    ``edges`` (K + 1,), in seconds, and ``variances`` are those of [u; y] in each of the rows (m +
    r,). ζ begins anew at the edges ``starts``, of several experiments; None: at the first one only.
    At the times of ``resets`` a matrix (S, k + S) makes s of [ζ; s], and ζ is zero. They are NaN
    where errors move s so fast that rounding decides how slow the rest of it is.
    """
    most = 1 if resets else len(rows.t) // _GROUPS
    per, before = _PER_ELAPSED, list[Array]()
    anew = edges[:1] if starts is None else starts
    while True:
        groups = grouped(rows, edges[-1], t, anew, most, per)
        found = _propagated(
            observer, estimator, gain, edges, groups, variances, t, anew, resets
        )
        if groups.alone or (before and all(map(_agree, before, found))):
            return found[0], found[1]
        finer = 4 if before else 2
        before, most, per = [*found], most // finer, per * finer


def _agree(coarse: Array, fine: Array) -> bool:
    largest = fine.max(axis=0, initial=0.0)
    return bool((np.abs(coarse - fine) <= _AGREE * (fine + _AGREE * largest)).all())


def _propagated(
    observer: ErrorsAt, estimator: ErrorsAt, gain: Array, edges: Array, groups: Groups,
    variances: Array, t: Array, starts: Array, resets: Sequence[tuple[float, Array]],
) -> tuple[Array, Array]:
    """:func:`deviations` of grouped rows; the gain is (M, n, p)."""
    n, p = gain.shape[1:]
    mesh = _mesh(edges, groups, np.union1d(starts, [time for time, _ in resets]))
    some = _joint(observer, estimator, mesh, slice(None, None, -(-mesh.size // _LOOKED)), n)
    if (rate := _rate(some)) * (edges[-1] - edges[0]) > _FASTEST:
        return np.full((len(t), p), np.nan), np.full((len(t), n), np.nan)
    mesh = _layered(mesh, groups.starts, rate, t)
    fresh, group = _group_of(mesh, groups.starts)
    until = np.append(groups.starts[1:], np.inf)
    sampler = mesh.sampler(t)
    of_eta, of_x = np.empty((len(t), p)), np.empty((len(t), n))
    zeta, own = (x(mesh.edges[:1], mesh.inside[0, :1]).A.shape[1] for x in (observer, estimator))
    size, signals = zeta + own, len(variances)
    stretch = max(1, _CHUNK // (size * mesh.rule.stages) ** 2)
    anew = np.zeros(mesh.size, dtype=bool)
    anew[np.searchsorted(mesh.edges, starts)] = True
    turns = {int(k): np.pad(np.eye(own), ((zeta, 0), (zeta, 0))) for k in np.flatnonzero(anew)}
    for time, turn in resets:
        turns[int(np.searchsorted(mesh.edges, time))] = np.pad(turn, ((zeta, 0), (0, 0)))
    L: Array | None = None
    # The errors that count in an element.
    beside = groups.first[group, None] + np.arange(1 + groups.memory.shape[1])
    beside = beside.clip(max=len(groups.shares) - 1)
    shares, memory = groups.shares[beside], groups.memory[beside]
    for first in range(0, mesh.size, stretch):
        part = slice(first, first + stretch)
        joint = _joint(observer, estimator, mesh, part, n)
        weights = groups.weights(mesh.points[part, 1:], group[part, None], until)
        B = np.concatenate([each[..., None, None] * joint.B for each in weights], axis=3)
        maps = _maps(mesh, mesh.steps[part], joint.A, B)  # of [ζ; s]
        chosen = (sampler.element >= first) & (sampler.element < first + stretch)
        element, places = sampler.element[chosen], sampler.weights[chosen]
        wanted, place = np.unique(element - first, return_inverse=True)
        factors, L = _factors(
            maps[:, -1], fresh[part], anew[part], shares[part, :, None] * np.sqrt(variances),
            memory[part], L, {k - first: turn for k, turn in turns.items()}, wanted,
        )
        if not len(wanted):
            continue
        before = factors[place]
        here = np.einsum("ms,msij->mij", places[:, 1:], maps[element - first])
        here[:, :, :size] += places[:, 0, None, None] * np.eye(size)
        reached = here @ before  # of [ζ; s] (M, size, ·)
        inside = mesh.inside[element, 1]
        o = observer(t[chosen], inside)
        C = joint.C if len(joint.C) == 1 else estimator(t[chosen], inside).C  # alike at all times
        eta = C @ reached[:, zeta:]
        rows = o.C.shape[1] - n  # of Y; those of the offset stand below
        now = groups.weights(t[chosen], group[element], groups.after)
        if not groups.alone:  # errors of one row and the one behind it, not of many
            now = now / shares[element].T
        e_now = sum(
            each[:, None, None] * before[:, size + k * signals : size + (k + 1) * signals]
            for k, each in enumerate(now)
        )
        x = gain[chosen] @ eta
        x += o.C[:, rows:] @ reached[:, :zeta] + o.D[:, rows:] @ e_now
        of_eta[chosen], of_x[chosen] = np.linalg.norm(eta, axis=2), np.linalg.norm(x, axis=2)
    return of_eta, of_x


def after_reset(system: ErrorSystem, reset: Reset, known: ExtensionState | None) -> Array:
    """s (S, k + S) after a reset where w starts from its estimate, of [ζ; s] before it.

    η₊ = T η + τ + V ζ and ζ₊ = 0. The error of 𝒴 becomes S δ𝒴 − Ω₊ V ζ, and that of an estimate
    from which the estimator starts T δη̂ − V ζ. The system of its errors is that at the end of the
    segment, with ``known`` [Ω | 𝒴]; None: there is no extension.
    """
    V, own = np.zeros((0, 0)) if reset.errors is None else reset.errors, system.A.shape[1]
    p, zeta = V.shape
    J = np.zeros((own, zeta + own))
    if known is not None:
        J[:p, zeta : zeta + p] = known.carries(reset)
        J[:p, :zeta] = -known.after(reset).values[:, :p] @ V
    if known is None or own > p:  # the last p of s are δη̂ itself
        J[-p:, zeta:], J[-p:, :zeta] = reset.transform @ system.C[0], -V
    return J


def of_least_squares(
    observer: ErrorsAt, regression: LinearRegression, known: Knowledge, gain: Array,
    rows: Rows, variances: Array,
) -> tuple[Array, Array]:
    """One standard deviation at the end of what least squares make of the data, (p,) and (n,).

    η̂ = G⁺h in units of the parameters' own sizes: what is not determined is left out, and its
    numbers mean nothing. The regression has no resets, ``known`` is of G with the end last, and the
    ``gain`` is that of the state at the end (n, p); the others are as of :func:`deviations`.
    """
    mesh, V = regression.mesh, known.vectors[-1]
    seen = known.eigenvalues[-1] >= known.level[-1].max(initial=0.0)
    inverse = np.where(seen, 1.0 / np.where(seen, known.eigenvalues[-1], 1.0), 0.0)
    inverse = (V * inverse) @ V.T / known.sizes[-1] / known.sizes[-1][:, None]
    of_eta, of_x = deviations(
        observer, _sums(regression, inverse), gain[None], mesh.edges, rows, variances,
        mesh.edges[-1:],
    )
    return of_eta[-1], of_x[-1]


def _sums(
    regression: LinearRegression, made: Array, weight: Callable[[Array], Array] | None = None
) -> ErrorsAt:
    """Errors of Y to those of what is made (k, p) of h = ∫ψᵀY, perhaps weighted at each time."""
    p = regression.p

    def of_h(t: Array, inside: Array) -> ErrorSystem:
        into = transpose(regression.psi(t, inside))
        if weight is not None:
            into = weight(inside)[:, None, None] * into
        return ErrorSystem(np.zeros((1, p, p)), into, made[None], np.zeros((1, *into.shape[1:])))

    return of_h


def noise_level(
    observer: ErrorsAt, regression: LinearRegression, rows: Rows, outputs: Array,
    starts: Array | None = None,
) -> float:
    """σ of recorded outputs from the residual of least squares of a regression without resets.

    All N rows count alike there, however far apart they are: in a pause a hold rule makes errors
    that are no noise. With G = Σψᵀψ, h = ΣψᵀY, r = Y − ψ G⁻¹h, and P_h the covariance of h for
    σ = 1,

        E Σ|r|² = σ² (Σ E|δY|² − tr(G⁻¹ P_h)):

    the second term is what the fit of p parameters takes away, the noise being coloured by ζ.
    ``outputs`` are variances of each signal [u; y] relative to σ², (m + r,), and the other
    arguments are as of :func:`deviations`.
    """
    mesh, k, p = regression.mesh, regression.psi.values.shape[2], regression.p
    start, stop = mesh.edges[[0, -1]].tolist()
    near = 1e-6 * float(np.diff(rows.t).min(initial=stop - start))
    own = rows.t[(rows.t > start - near) & (rows.t < stop + (near if rows.lines else -near))]
    if not len(own):
        return np.nan
    own = own.clip(start, stop)
    root = regression.factor
    if root is None:
        root = np.sqrt((stop - start) / len(own)) * triangular(
            np.concatenate([regression.psi(t), regression.Y(t)[:, :, None]], axis=2)
            .reshape(-1, p + 1) for t in np.array_split(own, 1 + len(own) // _ROWS)
        )
    _, sigma, Vt = np.linalg.svd(root[:, :p], full_matrices=False)
    known = sigma > np.sqrt(_SINGULAR) * sigma.max(initial=0.0)
    inverse = np.where(known, 1.0 / np.where(known, sigma, 1.0), 0.0)[:, None] * Vt

    def of_Y(t: Array, inside: Array) -> ErrorSystem:
        o = observer(t, inside)
        C, D = o.C[:, :k], o.D[:, :k]
        return ErrorSystem(
            o.A, o.B, np.concatenate([C, C], axis=1), np.concatenate([D, D], axis=1)
        )

    ends = np.union1d(own, [start, stop])
    density = (stop - start) / (np.diff(ends) * (len(ends) - 1))

    def weight(t: Array) -> Array:
        return np.asarray(density[np.searchsorted(ends, t, side="right").clip(1, len(density)) - 1])

    t = own[np.unique(np.linspace(0, len(own) - 1, _TIMES).round().astype(np.intp))]
    t = np.append(t, stop)
    of_fit, of_rows = deviations(
        of_Y, _sums(regression, inverse, weight), np.zeros((len(t), k, len(inverse))), mesh.edges,
        rows, outputs, t, starts,
    )
    whole = (stop - start) * float((of_rows[:-1] ** 2).sum(axis=1).mean())
    left = whole - float((of_fit[-1] ** 2).sum())
    eta = inverse.T @ (inverse @ (root[:, :p].T @ root[:, p]))
    square = float(((root @ np.append(-eta, 1.0)) ** 2).sum())
    more = len(own) * np.count_nonzero(outputs) > known.sum()  # numbers than estimates
    return float(np.sqrt(square / left)) if more and left > _LEFT * whole else np.nan


def _mesh(edges: Array, groups: Groups, starts: Array) -> Mesh:
    """Elements between edges and groups.

    Edges at rows within a group are left out: ψ bends there at most, as the errors do. Elements are
    shorter behind those of the edges where laws start, ``starts`` (S,), ascending.
    """
    instants = groups.starts
    near = 1e-9 * float(np.diff(edges).min())
    inner = ~among(edges, groups.others, near)
    inner[[0, -1]] = True
    own = instants[~among(instants, edges, near)]
    own = own[(own > edges[0]) & (own < edges[-1])]
    coarse = np.union1d(edges[inner], own)
    first = np.searchsorted(coarse, starts).clip(max=len(coarse) - 2)
    begun = coarse[first]
    early = np.diff(coarse)[first, None] * 0.5 ** np.arange(1, _HALVINGS)
    early[early < _SHORTEST * np.abs(coarse).max()] = 0.0
    mesh = Mesh(np.union1d(coarse, begun[:, None] + early), radau_rule(_STAGES))
    since = mesh.edges[1:] - begun[np.searchsorted(begun, mesh.edges[1:]).clip(1) - 1]
    parts = np.maximum(_ELEMENTS / (len(coarse) - 1), _SINCE * mesh.steps / since)
    return mesh.split(np.ceil(parts).clip(max=_MOST_PARTS).astype(np.intp))[0]


def _rate(joint: ErrorSystem) -> float:
    """The fastest rate, in 1/s, of what the errors of samples move directly."""
    moved = joint.B.any(axis=3)
    return float(np.abs(np.einsum("ksii->ksi", joint.A)[moved]).max(initial=0.0))


def _layered(mesh: Mesh, instants: Array, rate: float, t: Array) -> Mesh:
    """With short elements behind samples, where what follows them with this ``rate`` makes a layer.

    The end of an element beyond the layer is accurate, but no polynomial goes through both of its
    ends. Only elements in which there are times of the output t (M,) are cut.
    """
    begins, sampler = _group_of(mesh, instants)[0], mesh.sampler(t)
    between = np.count_nonzero(sampler.weights, axis=1) > 1  # and not at a node
    begins &= np.bincount(sampler.element[between], minlength=mesh.size) > 0
    h, left = mesh.steps[begins], mesh.edges[:-1][begins]
    fast = rate * h.max(initial=0.0)
    cuts = int(np.ceil(np.log(max(fast, 1.0)) / np.log(_LONGER)))
    parts = h * _LONGER ** -np.arange(1.0, 1.0 + cuts)[:, None]
    useful = (rate * parts * _LONGER > 1.0) & (parts > _SHORTEST * np.abs(mesh.edges).max())
    return Mesh(np.union1d(mesh.edges, (left + parts)[useful]), mesh.rule)


def _group_of(mesh: Mesh, instants: Array) -> tuple[BoolArray, IntArray]:
    """Whether a group, each from its instant on, begins with an element, and which it is in."""
    middle = mesh.edges[:-1] + 0.5 * mesh.steps
    group = np.searchsorted(instants, middle, side="right").clip(1) - 1
    return np.diff(group, prepend=-1) > 0, group


def _maps(mesh: Mesh, steps: Array, A: Array, B: Array) -> Array:
    """z at each node from that at the left end and from e, z' = A z + B e; (K, s, d, d + c).

    A (K, s, d, d) and B (K, s, d, c) are at the nodes of elements with these ``steps`` (K,).
    """
    K, E = len(steps), None
    size = 1.0 + steps[:, None] * np.abs(A).max(axis=(1, 3), initial=0.0)
    # Beside the rows of a law with a large gain those of its filters would be rounding.
    if size.max(initial=0.0) > _STIFF:
        A, B = (x / size[:, None, :, None] for x in (A, B))
        E = (np.eye(A.shape[-1]) / size[:, None]).repeat(1 + A.shape[1], axis=0)
    # At the left ends nothing is looked at.
    A, B = (np.concatenate([x[:, :1], x], axis=1) for x in (A, B))
    A, B = (x.reshape(K * x.shape[1], *x.shape[2:]) for x in (A, B))
    return np.concatenate(elements.element_maps(
        mesh.rule.differentiation, steps, E, A, B, None, None, np.arange(K), K
    ), axis=3)


def error_steps(mesh: Mesh, times: Array, lines: BoolArray, A: Array, B: Array) -> Array:
    """ζ at each time but the first from that before and from the errors e at both, (K, k, k + 2 c).

    Of elements between the times (K + 1,) of samples; between them e is linear where ``lines``
    (c,), else held. Of ζ' = A ζ + B e, A (elements or 1, s + 1 or 1, k, k) and B (…, k, c) are at
    the points of the mesh.
    """
    points = mesh.points[:, 1:]
    after = np.searchsorted(times, mesh.edges[1:] - 0.5 * mesh.steps)  # whose step it is part of
    # Of the newer of both errors.
    share = (points - times[after - 1, None]) / (times[after] - times[after - 1])[:, None]
    A, B = (
        np.broadcast_to(each[:, -mesh.rule.stages :], (*points.shape, *each.shape[2:]))
        for each in (A, B)
    )
    share = share[..., None, None] * lines
    ends = _maps(mesh, mesh.steps, A, np.concatenate([(1.0 - share) * B, share * B], axis=3))[:, -1]
    if len(ends) == len(times) - 1:
        return ends
    k = ends.shape[1]
    out = np.zeros((len(times) - 1, *ends.shape[1:]))
    out[:, :, :k] = np.eye(k)
    for end, step in zip(ends, after - 1, strict=True):
        out[step] = end[:, :k] @ out[step]
        out[step, :, k:] += end[:, k:]
    return out


def _joint(
    observer: ErrorsAt, estimator: ErrorsAt, mesh: Mesh, part: slice, n: int
) -> ErrorSystem:
    """A (K, s, d, d) and B (K, s, d, m + r) of [ζ; s] at the nodes of some elements; C of s."""
    points, inside = mesh.points[part, 1:].ravel(), mesh.inside[part, 1:].ravel()
    o, e = observer(points, inside), estimator(points, inside)
    zeta, own, signals = o.A.shape[1], e.A.shape[1], o.B.shape[2]
    rows = o.C.shape[1] - n
    A = np.zeros((len(points), zeta + own, zeta + own))
    A[:, :zeta, :zeta] = o.A
    A[:, zeta:, :zeta] = e.B @ o.C[:, :rows]
    A[:, zeta:, zeta:] = e.A
    B = np.zeros((len(points), zeta + own, signals))
    B[:, :zeta] = o.B
    B[:, zeta:] = e.B @ o.D[:, :rows]
    shape = (-1, mesh.rule.stages, zeta + own)
    return ErrorSystem(A.reshape(*shape, zeta + own), B.reshape(*shape, signals), e.C, e.D)


def _factors(
    ends: Array, fresh: BoolArray, anew: BoolArray, deviations: Array, memory: Array,
    L: Array | None, turns: Mapping[int, Array], wanted: IntArray,
) -> tuple[Array, Array]:
    """L of [ζ; s; e] at the left ends of elements ``wanted`` (W, d + a (m + r), ·), and at the end.

    The errors of several rows stand in L side by side, before it is made triangular again. An
    element makes ``ends`` of it (K, d, d + a (m + r)). Of the a errors that count, with
    ``deviations`` (K, a, m + r) and a ``memory`` (K, a, a − 1) of those before them, the first
    gives way to another one where ``fresh``, and all of them do where ``anew``. Matrices ``turns``
    (d, d) make [ζ; s] of itself at the left ends of some elements.
    """
    size, (alive, signals) = ends.shape[1], deviations.shape[1:]
    own, whole = np.arange(signals), size + alive * signals
    width = whole + _BESIDE * signals
    L = np.zeros((whole, whole)) if L is None else L
    used = L.shape[1]
    L = np.pad(L, ((0, 0), (0, width - used)))
    out, told = np.empty((len(wanted), *L.shape)), 0
    asked = np.isin(np.arange(len(ends)), wanted).tolist()
    for k, end in enumerate(ends):
        if k in turns:
            L[:size] = turns[k] @ L[:size]
        for block in range(0 if anew[k] else alive - fresh[k], alive):
            if used == width:
                L[:, :whole] = np.asarray(np.linalg.qr(L.T, mode="r")).T
                L[:, whole:] = 0.0
                used = whole
            L[size : whole - signals] = L[size + signals :]
            L[whole - signals :] = 0.0
            for back, share in enumerate(memory[k, block].tolist(), 2):
                if share:
                    before = whole - back * signals
                    L[whole - signals :] += share * L[before : before + signals]
            L[whole - signals + own, used + own] = deviations[k, block]
            used += signals
        if asked[k]:
            out[told], told = L, told + 1
        L[:size] = end @ L
    return out, L


class SampledDeviations:
    """One standard deviation from one sample to the next; it remembers L and no past."""

    def __init__(
        self, variances: Array, number: Callable[[Array], Array] | None, *, relative: bool
    ) -> None:
        """Prepare for the first sample.

        With variances of each sample of [u; y], (m + r,), and the ``number`` of the sample whose
        errors times (K,) have; None: each its own. If ``relative``, what :meth:`update` finds is a
        factor.
        """
        self._deviations, self._number, self._relative = np.sqrt(variances), number, relative
        self.noisy = variances > 0.0  # (m + r,)
        self._factors: list[Array] = []  # L of [ζ; e; s] of each case
        self._before: tuple[Array, Array] | None = None  # C and D of the last sample
        self._last = -np.inf
        self._expected, self._square = 0.0, 0.0  # E∫|δY|² so far, E|δY|² at the last sample

    def update(
        self, observer: ErrorSteps, cases: Sequence[ErrorRecursion],
        regression: SampledRegression, gain: Array, roots: Array,
    ) -> tuple[Array, Array]:
        """Deviations of η̂ and x̂ of every case at K samples (G, K, p + n), and their factor (K,).

        ``observer`` takes errors of [u; y] to those of Y and of the state's offset, ``cases`` those
        of Y to those of η̂. The gain of x = offset + gain η is (K, n, p), or of each case its own,
        (G, K, n, p), and ``roots`` are S of all data so far, without forgetting, (K, p + 1, p + 1).
        """
        count, n, p = gain.shape[-3:]
        gains = np.broadcast_to(gain, (len(cases), count, n, p))
        k, rows, signals = observer.step.shape[1], observer.C.shape[1] - n, len(self._deviations)
        C, D = observer.C, observer.D
        before = (C[:1], D[:1]) if self._before is None else self._before
        self._before = C[-1:], D[-1:]
        C_old, D_old = (
            np.concatenate([old, new[:-1]])[:, :rows]
            for old, new in zip(before, (C, D), strict=True)
        )
        number = regression.t if self._number is None else self._number(regression.t)
        fresh = np.diff(number, prepend=self._last) > 0
        self._last = float(number[-1])
        Y_new = C[:, :rows] @ observer.step  # δY' of [ζ; e; e'], but for D e'
        Y_new[:, :, k + signals :] += D[:, :rows]
        Y_old = np.concatenate([C_old, D_old, np.zeros((count, rows, signals))], axis=2)
        if self._relative:  # with h as of least squares
            plain = integrating(regression)
            cases = [_beside(ErrorRecursion(*plain, plain.A), cases[0]), *cases[1:]]
        out = np.empty((len(cases), count, p + n))
        for g, case in enumerate(cases):
            size = k + signals + case.A.shape[1]
            M = np.zeros((count, size, size + signals))
            both = np.r_[: k + signals, size : size + signals]  # ζ and the errors of two samples
            M[:, :k, both] = observer.step
            M[:, k : k + signals, size:] = np.eye(signals)
            M[:, k + signals :, both] = case.old @ Y_old + case.new @ Y_new
            M[:, k + signals :, k + signals : size] = case.A
            if len(self._factors) <= g:
                self._factors.append(np.zeros((size, size)))
            L = self._recursion(g, M, fresh, slice(k, k + signals))
            eta = case.C @ L[:, k + signals :]
            own = eta[:, -p:]
            x = gains[g] @ own + C[:, rows:] @ L[:, :k] + D[:, rows:] @ L[:, k : k + signals]
            out[g] = np.linalg.norm(np.concatenate([own, x], axis=1), axis=2)
            if g == 0 and self._relative:
                of_Y = C[:, :rows] @ L[:, :k] + D[:, :rows] @ L[:, k : k + signals]
                level = self._level(regression, (of_Y**2).sum(axis=(1, 2)), eta[:, :p], roots)
        return out, level if self._relative else np.ones(count)

    def _recursion(self, g: int, M: Array, fresh: BoolArray, errors: slice) -> Array:
        """L of one case at the samples, (K, d, d), from [z; e'] to z' (K, d, d + signals)."""
        L, size = self._factors[g], M.shape[1]
        out = np.empty((len(M), size, size))
        new = np.diag(self._deviations)
        for i, step in enumerate(M):
            if fresh[i]:
                wide = np.hstack([step[:, :size] @ L, step[:, size:] @ new])
                L = np.asarray(np.linalg.qr(wide.T, mode="r")).T
            else:  # the errors are those of the sample before
                same = step[:, :size].copy()
                same[:, errors] += step[:, size:]
                L = same @ L
            out[i] = L
        self._factors[g] = L
        return out

    def _level(
        self, regression: SampledRegression, of_Y: Array, of_h: Array, roots: Array
    ) -> Array:
        """σ (K,) from the residual so far, see :func:`noise_level`; NaN where nothing is left."""
        old, new = regression.shares
        before = np.append(self._square, of_Y[:-1])
        expected = self._expected + np.cumsum(old * before + new * of_Y)
        self._expected, self._square = float(expected[-1]), float(of_Y[-1])
        _, sigma, Vt = np.linalg.svd(roots[:, :-1, :-1])
        known = sigma**2 > _SINGULAR * sigma[:, :1] ** 2
        fitted = np.where(known, 1.0 / np.where(known, sigma, 1.0), 0.0)[..., None] * (Vt @ of_h)
        left = expected - (fitted**2).sum(axis=(1, 2))
        left[left <= _LEFT * expected] = np.nan
        return np.asarray(np.abs(roots[:, -1, -1]) / np.sqrt(left))


def _beside(a: ErrorRecursion, b: ErrorRecursion) -> ErrorRecursion:
    """Two systems of the same errors of Y as one, one above the other."""
    def diagonal(x: Array, y: Array) -> Array:
        out = np.zeros((len(x), x.shape[1] + y.shape[1], x.shape[2] + y.shape[2]))
        out[:, : x.shape[1], : x.shape[2]], out[:, x.shape[1] :, x.shape[2] :] = x, y
        return out

    return ErrorRecursion(
        diagonal(a.A, b.A), np.concatenate([a.old, b.old], axis=1),
        np.concatenate([a.new, b.new], axis=1), diagonal(a.C, b.C),
    )
