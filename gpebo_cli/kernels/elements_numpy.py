"""Collocation on elements: their systems, and chaining."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gpebo_cli.kernels.arrays import Array, IntArray, inverses

_EPS, _TINY = float(np.finfo(float).eps), float(np.finfo(float).tiny)
_ORDERS = 48  # of a series


def element_maps(
    D: Array, h: Array, E: Array | None, A: Array, f: Array, basis: Array | None,
    offset: Array | None, group: IntArray, groups: int,
    solve: Callable[..., Array] | None = None,
) -> tuple[Array, Array]:
    """X at the nodes = homogeneous (groups, s, n, n) X(left end) + particular (K, s, n, c).

    Block systems (D_ij/h E_i T_j − δ_ij A_i T_i) z_j = (D𝟙)_i/h E_i x_0 + f_i + A_i p_i − E_i (D
    p)_i/h with X_i = T_i z_i + p_i. Elements of one group, all of one length and with constant E, A
    and T, share the system of the first of them.

    D is the differentiation matrix of the rule (s, s), h the lengths (K,). At the K (s + 1) points
    of all elements, or at one: E (P or 1, d, n), None for the identity, A likewise, f (P or 1, d,
    c), T as ``basis`` (P or 1, n, d), None for the identity, and p as ``offset`` (P or 1, n, c),
    None without T. Each element is of a ``group`` (K,), 0 … groups − 1; ``solve`` stands in for
    :func:`solve_blocks`, and may raise LinAlgError as that does.
    """
    k, s, columns = len(h), len(D), f.shape[2]
    d, n = A.shape[1:]
    forcing, identity = at_nodes(f, k, s), np.eye(n)[None]
    E_, A_ = (at_nodes(identity if x is None else x, k, s) for x in (E, A))
    if offset is not None:  # what drives z: f + A p − E (D p)/h
        p = at_nodes(offset, k, s)
        slope = np.matmul(D / h[:, None, None], p.reshape(k, s, -1)).reshape(p.shape)
        forcing = forcing + A_ @ p - E_ @ slope
    T_ = None if basis is None else at_nodes(basis, k, s)
    start = D.sum(axis=1)[:, None, None]
    homogeneous, particular = np.empty((groups, s, n, n)), np.empty((k, s, n, columns))
    ends = np.bincount(group, minlength=groups).cumsum()
    for g, same in enumerate(np.split(np.argsort(group, kind="stable"), ends[:-1])):
        first = same[0]
        step, T = float(h[first]), None if T_ is None else T_[first]
        right = np.empty((s, d, n + len(same) * columns))
        right[:, :, :n] = start / step * E_[first]
        right[:, :, n:] = np.moveaxis(forcing[same], 0, 2).reshape(s, d, len(same) * columns)
        solved = (solve or solve_blocks)(D, step, E_[first], A_[first], T, right)
        solved = solved if T is None else T @ solved
        homogeneous[g] = solved[:, :, :n]
        particular[same] = np.moveaxis(
            solved[:, :, n:].reshape(s, n, len(same), columns), 2, 0
        )
    if offset is not None:
        particular += p
    return homogeneous, particular


def solve_blocks(
    D: Array, h: float, E: Array, A: Array, T: Array | None, right: Array
) -> Array:
    """z (s, d, c) of (D_ij/h E_i T_j − δ_ij A_i T_i) z_j = right (s, d, c).

    E and A are those at the nodes (s, d, n), T (s, n, d), None for the identity.
    """
    s, d, columns = right.shape
    coupling = E[:, :, None] if T is None else np.tensordot(E, T, axes=(2, 1))
    system = coupling * (D / h)[:, None, :, None]
    stage = np.arange(s)
    system[stage, :, stage] -= A if T is None else A @ T
    z = np.linalg.solve(system.reshape(s * d, s * d), right.reshape(s * d, columns))
    return np.asarray(z, dtype=np.float64).reshape(right.shape)


def at_nodes(values: Array, k: int, s: int) -> Array:
    """(k (s + 1), ...) or (1, ...) at points -> (k, s, ...) at nodes."""
    if len(values) == 1:
        return np.broadcast_to(values, (k, s, *values.shape[1:]))
    return values.reshape(k, s + 1, *values.shape[1:])[:, 1:]


def chain(
    homogeneous: Array, particular: Array, start: Array,
    renew: Callable[[Array], Array] | None = None,
) -> tuple[Array, int]:
    """Values (K, s + 1, n, c) at all points from the maps of the elements.

    Of the responses to the left ends (K or 1, s, n, n), particular solutions (K, s, n, c) and the
    value at the first left end (n, c). ``renew`` replaces the value (n, c) that an element before
    has reached. The second result is how many elements in front are finite.
    """
    size, s, n, columns = particular.shape
    maps = np.broadcast_to(homogeneous, (size, s, n, n))
    values = np.empty((size, s + 1, n, columns))
    with np.errstate(over="ignore", invalid="ignore"):  # the caller looks at what is finite
        state = start
        for k in range(size):
            if renew is not None and k > 0 and np.isfinite(state).all():
                state = renew(state)
            values[k, 0] = state
            state = maps[k, -1] @ state + particular[k, -1]
        values[:, 1:] = maps @ values[:, :1] + particular
    finite = np.isfinite(values).all(axis=(1, 2, 3))
    return values, size if finite.all() else int(np.argmin(finite))


def carried_errors(
    values: Array, to_legendre: Array, powers: Array, last: Array, particular: Array, noise: Array,
    signs: Array, level: float, end: float, most_factor: float,
) -> tuple[Array, Array]:
    """How far errors of elements may be carried, and what else counts of the solution.

    Each element adds what its polynomial leaves out, and rounding of everything its values are
    made of. End points are superconvergent, of order 2s − 1 against s + 1 inside: with ρ the decay
    per coefficient their error is about ρ^(s−1) times the tail. Half that exponent is used.

    Values are at the points (K, s + 1, n, c); ``to_legendre`` (s + 1, s + 1) makes coefficients of
    them, ``powers`` (j,) of each of the last ones the next. ``last`` (K or 1, n, n) are maps from
    left to right ends, ``particular`` (K or 1, n, c) right ends from zero, ``noise`` that of the
    terms in an element, see :func:`numerics.errors.estimated_errors`, ``signs`` those of each kind
    of error at the start and the ends (K + 1, n, 2 S). Coefficients that fall by less than
    ``level`` over two degrees are noise; ``end`` units in the last place are lost in solving an
    element. The sum of k errors may exceed its root mean square by √k; where it is rounding, by the
    root of the ``most_factor``.

    Returns:
        bounds of the errors at right ends (K, n, c); and the largest over time (5, n, c) of these,
        of tails, of values, of noise that shows, and of what right ends are made of.
    """
    K, points, n, columns = values.shape
    S = signs.shape[2] // 2
    with np.errstate(over="ignore", invalid="ignore"):
        turned = np.swapaxes(values, 0, 1).reshape(points, -1)
        most = np.zeros((5, K, n, columns))
        carried, tail, sizes, visible, made_of = most
        np.abs(turned).max(axis=0, out=sizes.ravel())
        shown = np.abs(to_legendre[-4:] @ turned)
        share = np.minimum(shown[-len(powers) :] / np.maximum(sizes, _TINY).ravel(), 1.0)
        share = (share ** powers[:, None]).max(axis=0).reshape(sizes.shape)
        if len(shown) == 4:
            before, after = np.maximum(shown[::2], shown[1::2])
            np.copyto(visible.ravel(), after, where=after >= level * before)
        made_of[:] = np.abs(last) @ np.abs(values[:, 0]) + np.abs(particular)
        tail[:] = sizes * share
        kinds = np.empty((K, n, 2, 1, columns))
        kinds[:, :, 0, 0] = tail * share ** (0.5 - 0.5 / (points - 1))
        kinds[:, :, 1, 0] = _EPS * (end * made_of + noise[..., :n] @ sizes + noise[..., n:])
        apart = signs.reshape(K + 1, n, 2, S, 1)
        added = (apart[1:] * kinds).reshape(K, n, 2 * S * columns)
        start = apart[0] * (_EPS * np.abs(values[0, 0]))[:, None, None]
        start[:, 0] = 0.0
        error, ends = start.reshape(n, 2 * S * columns), np.empty_like(added)
        for k in range(K):
            ends[k] = error = last[k if len(last) > 1 else 0] @ error + added[k]
        squares = np.square(ends).reshape(K, n, 2, S, columns).sum(axis=3)
        most_of = np.array([np.inf, most_factor])[:, None]
        factors = np.minimum(np.arange(2.0, K + 2.0)[:, None, None, None], most_of)
        np.sqrt(squares * (factors / S)).sum(axis=2, out=carried)
        return carried, most.max(axis=1)


def series(
    nodes: Array, h: Array, parts: IntArray, rows: IntArray, indices: IntArray, A: Array,
    decay: Array, f: Array, kicks: Array | None, start: Array, weights: Array, tol: float,
    share: float,
) -> tuple[Array, Array]:
    """Values at all points of X' = A X + f by series in time, one element after the other.

    ``(k + 1) X_{k+1} = h (Σ A_j X_{k−j} + f_k)`` until nothing that can follow is larger than
    ``tol``, relative to the largest a row has been in the part, or to a ``share`` of the largest of
    all rows, times their weights (d,). Nodes of the rule (s,) are in (0, 1], h are lengths (K,); an
    element has so many equal ``parts`` (K,), P in all, each with a series: in powers of its
    time, which ends at 1, the entries of A have coefficients (P or 1, e, g), from each power on at
    most ``decay`` (P or 1, g) relative to the entry, and the first columns of X f (P or 1, u, d,
    f). Each row of A begins somewhere (d + 1,) in the columns ``indices`` (e,). ``kicks`` (K, d, c)
    or None are added to X at the end of each element; it begins with ``start`` (d, c).

    Returns:
        (K, s + 1, d, c), before what is added; ``tol`` (K,), or ∞ and zeros if 48 terms fail.
    """
    (d, columns), all_rows = start.shape, np.repeat(np.arange(len(rows) - 1), np.diff(rows))
    values, changes = np.empty((len(h), len(nodes) + 1, d, columns)), np.full(len(h), tol)
    matrices, forcing = np.zeros((A.shape[2], d, d)), np.zeros((_ORDERS, d, columns))
    state, part = start, 0
    for k, count in enumerate(parts.tolist()):
        values[k, 0] = state
        for i in range(count):
            matrices[:, all_rows, indices] = A[part % len(A)].T
            forcing[: f.shape[1], :, : f.shape[3]] = f[part % len(f)]
            largest = weights * np.abs(state).max(axis=1, initial=0.0)
            terms, sizes, left = [state], [1.0], np.inf
            while len(terms) < _ORDERS and np.isfinite(sizes[0]) and not left <= tol:
                pairs = zip(matrices, reversed(terms), strict=False)
                right = sum((a @ x for a, x in pairs), forcing[len(terms) - 1])
                terms.append(h[k] / count / len(terms) * right)
                moved = weights * np.abs(terms[-1]).max(axis=1, initial=0.0)
                largest = np.maximum(largest, moved)
                least = max(share * largest.max(initial=0.0), _TINY)
                sizes.insert(0, (moved / np.maximum(largest, least)).max(initial=0.0))
                left = max(a * b for a, b in zip(decay[part % len(decay)], sizes, strict=False))
                left = left if len(terms) > f.shape[1] else np.inf
            if not left <= tol:
                changes[k], terms = np.inf, [np.zeros((d, columns))]
            here = (nodes * count > i) & (nodes * count <= i + 1)
            powers = (nodes[here, None] * count - i) ** np.arange(len(terms))
            values[k, 1:][here] = np.tensordot(powers, np.array(terms), axes=1)
            state, part = np.sum(terms, axis=0), part + 1
        state = state if kicks is None else state + kicks[k]
    return values, changes


def stiff(
    D: Array, h: Array, origin: IntArray, products: IntArray, steps: IntArray, A: Array, f: Array,
    kicks: Array | None, start: Array,
) -> Array:
    """Values of (D/h ⊗ I − A) X = D𝟙/h x_0 + f by elimination, one element after the other.

    There are full blocks (s, s): D/h less a diagonal one for each state, and others that are zero
    or a diagonal one to begin with. Diagonal ones are entries A (P or 1, e) at the nodes: those
    that ``origin`` (B,) says, or none for −1; their own numbers are from B on. ``products`` (o, 4)
    say what is done to block t with l, p and r: it becomes its inverse if t is p, else l p r is
    added, or taken from a state's own. Then, with a right-hand side b and x = 0, ``steps`` (m, 3)
    say target t, source i and block Z: x_t += Z b_t and then b_t = 0, if t is i; else b_t += Z x_i.
    The rest is as of :func:`series`, with f (Q or 1, d, f).
    """
    (K, s), (d, columns) = (len(h), len(D)), start.shape
    diagonal = np.moveaxis(at_nodes(A, K, s), 2, 0)[..., None] * np.eye(s)
    none = np.zeros((K, s, s))
    blocks = [
        D / h[:, None, None] - (diagonal[e] if e >= 0 else none) if i < d
        else diagonal[e] if e >= 0 else none for i, e in enumerate(origin.tolist())
    ]
    blocks += list(diagonal)
    for t, left, pivot, right in products.tolist():
        if t == pivot:
            blocks[t] = inverses(blocks[t])
        else:
            more = blocks[left] @ blocks[pivot] @ blocks[right]
            blocks[t] = blocks[t] - more if t < d else blocks[t] + more
    values, state = np.empty((K, s + 1, d, columns)), start
    for k, slope in enumerate(D.sum(axis=1) / h[:, None]):
        right = state[:, None] * slope[:, None]
        given = f if len(f) == 1 else f[k * (s + 1) + 1 : (k + 1) * (s + 1)]
        right[:, :, : f.shape[2]] += np.moveaxis(given, 0, 1)
        b, x = list(right), [np.zeros((s, columns))] * d
        for t, i, block in steps.tolist():
            term = blocks[block][k] @ (b[t] if t == i else x[i])
            if t == i:
                x[t], b[t] = x[t] + term, np.zeros((s, columns))
            else:
                b[t] = b[t] + term
        values[k, 0] = state
        np.stack(x, axis=1, out=values[k, 1:])
        state = values[k, -1] if kicks is None else values[k, -1] + kicks[k]
    return values
