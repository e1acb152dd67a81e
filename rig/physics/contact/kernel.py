"""The compiled contact step: one implicit time step of unilateral contact with Coulomb friction.

The unknowns of a step are the object's approach d, its tangential increment Δx, and for every node
in contact its pressing force p and tangential force t. The rows of the system are the force balance
(or the commanded position) of the object, closed gap, and stick (no relative motion) or slip (t =
±μ p). Which rows apply is the active set. The inverse of the system is stored from step to step and
*updated* when a node changes: a replaced row or a bordered slot costs n², a new inverse n³. A step
whose active set does not settle is reported, never accepted.

The time rule is backward Euler: u' = α W f + β u, with α = 1/(1 + τ/Δt) and β = 1 - α. Friction
uses the coefficient of each node at the start of the step, so that a step is a Coulomb problem with
constant coefficients.

Most steps end with the active set they began with, or with slipping nodes that stick for a moment.
`_again` tries this first, with the inverse as it is: a node that sticks bears a tangential force in
addition to its friction, and a small system gives the forces that keep such nodes from sliding
(`_hold_back`). It computes only the nodes in contact, whose positions follow from their rows. The
displacement is W g, where g is the force behind the same rule, so the motion of an open node since
it was last computed is bounded by the change of g. While this bound is less than its gap the node
stays open and need not be computed. Every other step is a whole one (`_step`): all displacements,
all rows' residuals.

All of it is one module because numba's cache checks the file of the function that is called, not
the files of those it calls.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

OPEN, STICK, SLIP_PLUS, SLIP_MINUS = 0, 1, 2, 3

# Integers of a state.
N, VALID, NORMAL_BY_FORCE, TANGENT_BY_FORCE, UPDATES, REBUILDS, RESCUES, AGAIN = range(8)
# Scalars of a state.
D, X, V, DRIFT = range(4)
# Entries of the list of the present active set.
LISTED, PACKED, TOUCHING, STICKING = range(4)
# Rows of integers by node: in contact, in order; for counting; slots of the inverse; whether a
# slipping one sticks; which do; whose response to a force is known; the set that is listed.
NODES, COUNTING, ORDER, MARKED, WHICH, ANSWERED, HELD = range(7)
# Columns of the summary of a step.
(
    OUT_D,
    OUT_FN,
    OUT_X,
    OUT_FT,
    OUT_DISSIPATED,
    OUT_AREA,
    OUT_ITERATIONS,
) = range(7)
SUMMARY = 7
# Constants of a stepper.
ALPHA, MU_S, MU_K, D_C, BROKEN_LEFT, REST, MASS_DT2, DT, CURVATURE = range(9)

SET_TOLERANCE_N = 1e-11
SET_TOLERANCE_MM = 1e-11
SLIP_TOLERANCE_MM = 1e-12
RESIDUAL_MM = 1e-10
PATIENCE = 12
ITERATIONS = 60
RESCUES_A_STEP = 30
FRICTION_TOLERANCE_N = 1e-12
"""Change of a tangential force at which the correction for changed coefficients has settled."""
FRICTION_ITERATIONS = 60
"""Largest number of its iterations, and of rounds in which nodes are held back."""
FRICTION_REFRESH = 0.05
"""Change of a coefficient from which the inverse is updated for it."""
FRICTION_SETTLES = 0.1
"""The inverse is also updated when the remaining change is less than this share of the change so
far."""
FRICTION_SETTLED = 1e-9
"""Smaller changes wait until the coefficient has stopped changing."""
EAGER = 2.0
"""Factor used by `_outdated`. It trades more updates of the inverse for fewer whole steps; chosen
by measurement."""
NEGLIGIBLE_SHARE = 1e-18
"""Share of the bonds, whole or broken, that changes no digit of the coefficient any more."""
REFRESH_UPDATES = 4000
FORGOTTEN_N = 1e-18
"""Force behind the rule of the time step that is taken as zero."""
LOOKED_AT_EVERY = 50
"""Steps with the same active set after which all residuals are computed again."""

_FAST = {"reassoc", "contract", "nsz"}


@njit(cache=True, error_model="numpy")
def _copy(source: Any, target: Any) -> None:
    """Copy source to target; written out, because numba compiles array assignments slowly."""
    for k in range(source.size):
        target[k] = source[k]


@njit(cache=True, error_model="numpy")
def _fill(target: Any, value: float) -> None:
    for k in range(target.size):
        target[k] = value


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _multiply(A: Any, b: Any, n: int, out: Any) -> None:
    """Compute out[:n] = A[:n, :n] b[:n], four rows at once so that each b[c] is fetched once."""
    r = 0
    while r + 4 <= n:
        t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
        for c in range(n):
            t0 += A[r, c] * b[c]
            t1 += A[r + 1, c] * b[c]
            t2 += A[r + 2, c] * b[c]
            t3 += A[r + 3, c] * b[c]
        out[r], out[r + 1], out[r + 2], out[r + 3] = t0, t1, t2, t3
        r += 4
    while r < n:
        total = 0.0
        for c in range(n):
            total += A[r, c] * b[c]
        out[r] = total
        r += 1


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _products(A: Any, rows: Any, count: int, b: Any, n: int, out: Any) -> None:
    """Compute out[q] = A[rows[q], :n] b[:n] for q < count, like `_multiply`."""
    q = 0
    while q + 4 <= count:
        r0, r1, r2, r3 = rows[q], rows[q + 1], rows[q + 2], rows[q + 3]
        t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
        for c in range(n):
            t0 += A[r0, c] * b[c]
            t1 += A[r1, c] * b[c]
            t2 += A[r2, c] * b[c]
            t3 += A[r3, c] * b[c]
        out[q], out[q + 1], out[q + 2], out[q + 3] = t0, t1, t2, t3
        q += 4
    while q < count:
        r0, t0 = rows[q], 0.0
        for c in range(n):
            t0 += A[r0, c] * b[c]
        out[q] = t0
        q += 1


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _add_products(A: Any, row: int, count: int, column: int, b: Any, n: int, out: Any) -> None:
    """Add A[row + q, column : column + n] b[:n] to out[q] for q < count, like `_products`."""
    q = 0
    while q + 4 <= count:
        r = row + q
        t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
        for c in range(n):
            t0 += A[r, column + c] * b[c]
            t1 += A[r + 1, column + c] * b[c]
            t2 += A[r + 2, column + c] * b[c]
            t3 += A[r + 3, column + c] * b[c]
        out[q] += t0
        out[q + 1] += t1
        out[q + 2] += t2
        out[q + 3] += t3
        q += 4
    while q < count:
        r, total = row + q, 0.0
        for c in range(n):
            total += A[r, column + c] * b[c]
        out[q] += total
        q += 1


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _multiply_left(b: Any, A: Any, n: int, out: Any) -> None:
    """Compute out[:n] = b[:n] A[:n, :n], four rows at once."""
    for c in range(n):
        out[c] = 0.0
    r = 0
    while r + 4 <= n:
        s0, s1, s2, s3 = b[r], b[r + 1], b[r + 2], b[r + 3]
        for c in range(n):
            out[c] += s0 * A[r, c] + s1 * A[r + 1, c] + s2 * A[r + 2, c] + s3 * A[r + 3, c]
        r += 4
    while r < n:
        s0 = b[r]
        for c in range(n):
            out[c] += s0 * A[r, c]
        r += 1


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _rank_one(A: Any, x: Any, y: Any, scale: float, n: int) -> None:
    """Add scale x y to A[:n, :n]."""
    for r in range(n):
        s = scale * x[r]
        if s != 0.0:
            for c in range(n):
                A[r, c] += s * y[c]


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _displacements(C: Any, force: Any, loaded: Any, count: int, out: Any) -> None:
    """Compute out = C force, where only the entries `loaded[:count]` of the force are not zero."""
    size = out.size
    _fill(out, 0.0)
    k = 0
    while k + 4 <= count:
        a, b, c, d = loaded[k], loaded[k + 1], loaded[k + 2], loaded[k + 3]
        fa, fb, fc, fd = force[a], force[b], force[c], force[d]
        for j in range(size):
            out[j] += C[a, j] * fa + C[b, j] * fb + C[c, j] * fc + C[d, j] * fd
        k += 4
    while k < count:
        a = loaded[k]
        fa = force[a]
        for j in range(size):
            out[j] += C[a, j] * fa
        k += 1


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _dot(a: Any, b: Any) -> float:
    total = 0.0
    for k in range(a.size):
        total += a[k] * b[k]
    return total


@njit(cache=True, error_model="numpy")
def _row(
    i: int, tangent: bool, stick: bool, slope: float, C: Any, inv_alpha: float, slots: Any, row: Any
) -> None:
    """Write the row of node `i` (closed gap, stick or slip) over the slots in use."""
    m = slots[0].size
    for k in range(row.size):
        row[k] = 0.0
    if tangent and not stick:
        row[slots[1][i]] = 1.0
        row[slots[0][i]] = -slope
        return
    source = C[m + i] if tangent else C[i]
    for j in range(m):
        p_slot = slots[0][j]
        if p_slot >= 0:
            row[p_slot] = source[j]
        t_slot = slots[1][j]
        if t_slot >= 0:
            row[t_slot] = source[m + j]
    row[1 if tangent else 0] = -inv_alpha


@njit(cache=True, error_model="numpy")
def _column(i: int, tangent: bool, C: Any, held: Any, slots: Any, ints: Any, column: Any) -> None:
    """Write how the unknown p (or t) of node `i` enters the rows in use."""
    m = held.size
    for k in range(column.size):
        column[k] = 0.0
    source = C[m + i] if tangent else C[i]
    for j in range(m):
        if slots[0][j] >= 0:
            column[slots[0][j]] = source[j]
        if slots[1][j] >= 0 and held[j] == STICK:
            column[slots[1][j]] = source[m + j]
    if tangent and ints[TANGENT_BY_FORCE] == 1:
        column[1] = 1.0
    if not tangent and ints[NORMAL_BY_FORCE] == 1:
        column[0] = 1.0


@njit(cache=True, error_model="numpy")
def _border(inverse: Any, n: int, row: Any, column: Any, diagonal: float, work: Any) -> bool:
    """Add one slot to the inverse; return False if that would be singular."""
    x, y = work[0], work[1]
    _multiply(inverse, column, n, x)
    _multiply_left(row, inverse, n, y)
    schur = diagonal - _dot(row[:n], x[:n])
    if abs(schur) < 1e-13:
        return False
    _rank_one(inverse, x, y, 1.0 / schur, n)
    for k in range(n):
        inverse[k, n] = -x[k] / schur
        inverse[n, k] = -y[k] / schur
    inverse[n, n] = 1.0 / schur
    return True


@njit(cache=True, error_model="numpy")
def _delete(inverse: Any, n: int, k: int, work: Any) -> bool:
    """Remove slot `k` and move the last slot into its place; return False if that is
    singular."""
    pivot = inverse[k, k]
    if abs(pivot) < 1e-13:
        return False
    x, y = work[0], work[1]
    for r in range(n):
        x[r] = inverse[r, k]
        y[r] = inverse[k, r]
    _rank_one(inverse, x, y, -1.0 / pivot, n)
    last = n - 1
    if k != last:
        for r in range(n):
            inverse[r, k] = inverse[r, last]
        for c in range(n):
            inverse[k, c] = inverse[last, c]
    return True


@njit(cache=True, error_model="numpy")
def _replace_row(inverse: Any, n: int, k: int, product: Any, work: Any) -> bool:
    """Replace row `k`; `product` is the new row times the inverse. Return False if that is
    singular."""
    pivot = product[k]
    if abs(pivot) < 1e-13:
        return False
    x = work[0]
    for r in range(n):
        x[r] = inverse[r, k]
    product[k] -= 1.0
    _rank_one(inverse, x, product, -1.0 / pivot, n)
    return True


@njit(cache=True, error_model="numpy")
def _take_slot(owner: Any, slots: Any, ints: Any, i: int, kind: int) -> None:
    n = ints[N]
    slots[kind][i] = n
    owner[n, 0], owner[n, 1] = kind, i
    ints[N] = n + 1


@njit(cache=True, error_model="numpy")
def _release_slot(owner: Any, slots: Any, ints: Any, i: int, kind: int) -> None:
    k, last = slots[kind][i], ints[N] - 1
    slots[kind][i] = -1
    if k != last:
        owner[k, 0], owner[k, 1] = owner[last, 0], owner[last, 1]
        slots[owner[k, 0]][owner[k, 1]] = k
    ints[N] = last


@njit(cache=True, error_model="numpy")
def _slope(status: int, mu: float) -> float:
    """Return t / p of a slipping node."""
    return mu if status == SLIP_PLUS else -mu


@njit(cache=True, error_model="numpy")
def _outdated(status: int, mu: float, slope: float, kinetic: float, eager: float) -> bool:
    """Return whether the stored slope of a slipping node has to be updated to its friction.

    This is so if the coefficient has changed much, or is about to stop changing. Until then every
    solution has to be corrected for it. An update that causes a whole step includes all nodes that
    are `eager` times as near to it.
    """
    if status < SLIP_PLUS:
        return False
    moved = eager * abs(_slope(status, mu) - slope)
    if moved > FRICTION_REFRESH or (mu == kinetic and moved > 0.0):
        return True
    return moved > FRICTION_SETTLED and abs(mu - kinetic) < FRICTION_SETTLES * moved


@njit(cache=True, error_model="numpy")
def _friction_row(
    i: int, C: Any, inv_alpha: float, status: Any, slopes: Any, mu: Any, slots: Any, ints: Any,
    inverse: Any, work: Any,
) -> bool:  # fmt: skip
    """Update the tangential row of node `i` to its status."""
    n, row, product = ints[N], work[2], work[3]
    k = slots[1][i]
    if status[i] == STICK:
        _row(i, True, True, 0.0, C, inv_alpha, slots, row)
        _multiply_left(row, inverse, n, product)
    else:
        slopes[i] = _slope(status[i], mu[i])
        p_slot = slots[0][i]
        for c in range(n):
            product[c] = inverse[k, c] - slopes[i] * inverse[p_slot, c]
    return _replace_row(inverse, n, k, product, work)


@njit(cache=True, error_model="numpy")
def _close(
    i: int, C: Any, inv_alpha: float, status: Any, held: Any, slopes: Any, mu: Any, slots: Any,
    owner: Any, ints: Any, inverse: Any, work: Any,
) -> bool:  # fmt: skip
    """Add both slots of node `i`, whose status is already that of contact."""
    row, column = work[2], work[3]
    for kind in range(2):
        tangent = kind == 1
        stick = status[i] == STICK
        if tangent and not stick:
            slopes[i] = _slope(status[i], mu[i])
        _column(i, tangent, C, held, slots, ints, column)
        if tangent and not stick:
            for k in range(row.size):
                row[k] = 0.0
            row[slots[0][i]] = -slopes[i]
            diagonal = 1.0
        else:
            _row(i, tangent, stick, 0.0, C, inv_alpha, slots, row)
            diagonal = C[C.shape[0] // 2 + i, C.shape[0] // 2 + i] if tangent else C[i, i]
        if not _border(inverse, ints[N], row, column, diagonal, work):
            return False
        _take_slot(owner, slots, ints, i, kind)
    return True


@njit(cache=True, error_model="numpy")
def _open(i: int, slots: Any, owner: Any, ints: Any, inverse: Any, work: Any) -> bool:
    """Remove both slots of node `i`."""
    for kind in (1, 0):
        if not _delete(inverse, ints[N], slots[kind][i], work):
            return False
        _release_slot(owner, slots, ints, i, kind)
    return True


@njit(cache=True, error_model="numpy")
def _pivot(A: Any, k: int, n: int) -> int:
    """Return the row from `k` on with the largest entry in column `k`."""
    best = k
    for r in range(k + 1, n):
        if abs(A[r, k]) > abs(A[best, k]):
            best = r
    return best


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _invert(A: Any, inverse: Any) -> bool:
    """Invert A by Gauss-Jordan with row pivots and destroy A; return False if A is singular or
    not finite."""
    n = A.shape[0]
    for r in range(n):
        for c in range(n):
            inverse[r, c] = 1.0 if r == c else 0.0
    for k in range(n):
        best = _pivot(A, k, n)
        if not abs(A[best, k]) > 1e-14:
            return False
        if best != k:
            for c in range(n):
                A[k, c], A[best, c] = A[best, c], A[k, c]
                inverse[k, c], inverse[best, c] = inverse[best, c], inverse[k, c]
        scale = 1.0 / A[k, k]
        for c in range(n):
            A[k, c] *= scale
            inverse[k, c] *= scale
        for r in range(n):
            factor = A[r, k]
            if r != k and factor != 0.0:
                for c in range(n):
                    A[r, c] -= factor * A[k, c]
                    inverse[r, c] -= factor * inverse[k, c]
    return True


@njit(cache=True, error_model="numpy")
def _rebuild(
    C: Any, constants: Any, status: Any, slopes: Any, mu: Any, slots: Any, owner: Any, ints: Any,
    inverse: Any, work: Any,
) -> None:  # fmt: skip
    """Invert the system of the present statuses from scratch."""
    m = status.size
    inv_alpha = 1.0 / constants[ALPHA]
    ints[N] = 2
    for i in range(m):
        slots[0][i] = -1
        slots[1][i] = -1
    for i in range(m):
        if status[i] != OPEN:
            _take_slot(owner, slots, ints, i, 0)
            _take_slot(owner, slots, ints, i, 1)
    n = ints[N]
    system = np.zeros((n, n))
    row = work[2]
    for i in range(m):
        if status[i] == OPEN:
            continue
        _row(i, False, True, 0.0, C, inv_alpha, slots, row)
        for c in range(n):
            system[slots[0][i], c] = row[c]
        if status[i] != STICK:
            slopes[i] = _slope(status[i], mu[i])
        _row(i, True, status[i] == STICK, slopes[i], C, inv_alpha, slots, row)
        for c in range(n):
            system[slots[1][i], c] = row[c]
        if ints[NORMAL_BY_FORCE] == 1:
            system[0, slots[0][i]] = 1.0
        if ints[TANGENT_BY_FORCE] == 1:
            system[1, slots[1][i]] = 1.0
    if ints[NORMAL_BY_FORCE] == 0:
        system[0, 0] = 1.0
    system[1, 1] = constants[MASS_DT2] if ints[TANGENT_BY_FORCE] == 1 else 1.0
    ints[VALID] = 1 if _invert(system, inverse) else 0
    ints[UPDATES] = 0
    ints[REBUILDS] += 1


@njit(cache=True, error_model="numpy")
def _right_side(
    constants: Any, w: Any, u: Any, height: Any, spin: Any, status: Any, slots: Any, ints: Any,
    normal: float, tangent: float, b: Any,
) -> None:  # fmt: skip
    """Compute the right-hand side of the rows in this step."""
    alpha = constants[ALPHA]
    beta = 1.0 - alpha
    b[0] = normal
    b[1] = tangent
    for i in range(status.size):
        if status[i] == OPEN:
            continue
        b[slots[0][i]] = (-height[i] - beta * w[i]) / alpha
        b[slots[1][i]] = (spin[i] + alpha * u[i]) / alpha if status[i] == STICK else 0.0


@njit(cache=True, error_model="numpy")
def _needed(status: Any, owner: Any, n: int, rows: Any) -> int:
    """List the rows of the inverse that a solution needs; for a slipping node t follows from p."""
    rows[0], rows[1] = 0, 1
    count = 2
    for k in range(2, n):
        if owner[k, 0] == 0 or status[owner[k, 1]] == STICK:
            rows[count] = k
            count += 1
    return count


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _correct_friction(
    effect: Any, row: int, column: int, press: Any, lack: Any, count: int, extra: Any,
    corrected: Any,
) -> bool:  # fmt: skip
    """Find the tangential forces `extra` (count,) that slipping nodes bear beyond the stored
    slopes; return False if the iteration does not settle.

    `lack` (count,) is what each stored slope lacks of the node's friction, `press` the pressing
    forces with the stored slopes, and `effect[row + s, column + c]` the change of the pressing
    force at node s by a unit of tangential force at node c. Only these few entries of the inverse
    take part in the iteration, so that coefficients may change far before it has to be updated.
    """
    for _ in range(FRICTION_ITERATIONS):
        worst = 0.0
        _copy(press[:count], corrected)
        _add_products(effect, row, count, column, extra, count, corrected)
        for s in range(count):
            moved = lack[s] * corrected[s] - extra[s]
            extra[s] += moved
            worst = max(worst, abs(moved))
        if worst < FRICTION_TOLERANCE_N:
            return True
    return False


@njit(cache=True, error_model="numpy")
def _solve(
    status: Any, slopes: Any, mu: Any, slots: Any, owner: Any, ints: Any, inverse: Any,
    force: Any, b: Any, solution: Any, rows: Any, needed: int, small: Any, work: Any, which: Any,
) -> bool:  # fmt: skip
    """Solve with the stored inverse, corrected for coefficients that have changed since then;
    return False if the correction does not settle.

    `solution` receives d, Δx and the results of the further `rows`.
    """
    n, m = ints[N], status.size
    lack, press, extra = work[13], work[14], work[15]
    lacking, settled = 0, True
    for i in range(m):
        if status[i] >= SLIP_PLUS:
            lack[lacking] = _slope(status[i], mu[i]) - slopes[i]
            if lack[lacking] != 0.0:
                which[lacking] = i
                lacking += 1
    _products(inverse, rows, needed, b, n, solution)
    if lacking > 0:
        for q in range(2, needed):
            k = rows[q]
            if owner[k, 0] == 0:
                press[owner[k, 1]] = solution[q]
        for s in range(lacking):
            press[s] = press[which[s]]  # the nodes are in order: none is overwritten too early
            extra[s] = lack[s] * force[which[s]]
            source = inverse[slots[0][which[s]]]
            for c in range(lacking):
                small[s, c] = source[slots[1][which[c]]]
        settled = _correct_friction(small, 0, 0, press, lack, lacking, extra, work[3])
        for s in range(lacking):
            b[slots[1][which[s]]] = extra[s]
        _products(inverse, rows, needed, b, n, solution)
    for q in range(2, needed):
        k = rows[q]
        i = owner[k, 1]
        if owner[k, 0] == 1:
            force[m + i] = solution[q]
            continue
        if status[i] >= SLIP_PLUS:
            force[m + i] = slopes[i] * solution[q] + b[slots[1][i]]
        force[i] = solution[q]
    return settled


@njit(cache=True, error_model="numpy")
def _closing_status(gap: float, slide: float, c_n: float, c_t: float, mu: float) -> int:
    """Return stick or slip for a node that comes into contact, from the projection of its trial
    force."""
    press, pull = -gap / c_n, -slide / c_t
    if pull > mu * press:
        return SLIP_PLUS
    if pull < -mu * press:
        return SLIP_MINUS
    return STICK


@njit(cache=True, error_model="numpy")
def _against(slide: float, held: int, mu: float) -> bool:
    """Return whether a slipping node slides against its friction."""
    backwards = slide if held == SLIP_PLUS else -slide
    return backwards > SLIP_TOLERANCE_MM and mu > 0.0


@njit(cache=True, error_model="numpy")
def _wanted(
    i: int, now: int, C: Any, alpha: float, mu: float, gap: float, slide: float, p: float, t: float
) -> int:
    """Return the status that node `i` should have by its forces and motion."""
    m = C.shape[0] // 2
    if now == OPEN:
        if gap < -SET_TOLERANCE_MM:
            return _closing_status(gap, slide, alpha * C[i, i], alpha * C[m + i, m + i], mu)
        return OPEN
    if p < -SET_TOLERANCE_N:
        return OPEN
    if now == STICK:
        if t > mu * p + SET_TOLERANCE_N:
            return SLIP_PLUS
        if t < -mu * p - SET_TOLERANCE_N:
            return SLIP_MINUS
        return STICK
    return STICK if _against(slide, now, mu) else now


@njit(cache=True, error_model="numpy")
def _follow(
    C: Any, constants: Any, status: Any, held: Any, slopes: Any, mu: Any, slots: Any, owner: Any,
    ints: Any, inverse: Any, work: Any,
) -> None:  # fmt: skip
    """Make the inverse that of `status`: updated if little changed, otherwise computed from
    scratch."""
    inv_alpha = 1.0 / constants[ALPHA]
    changed, eager = 0, 1.0
    for i in range(status.size):
        if status[i] != held[i]:
            changed += 1
        if _outdated(status[i], mu[i], slopes[i], constants[MU_K], 1.0):
            eager = EAGER
    valid = ints[VALID] == 1 and ints[UPDATES] < REFRESH_UPDATES and 3 * changed <= ints[N]
    for i in range(status.size):
        if not valid:
            break
        now, old = status[i], held[i]
        if now != old and now == OPEN:
            valid = _open(i, slots, owner, ints, inverse, work)
        elif now != old and old == OPEN:
            valid = _close(
                i, C, inv_alpha, status, held, slopes, mu, slots, owner, ints, inverse, work
            )
        elif now != old or _outdated(now, mu[i], slopes[i], constants[MU_K], eager):
            valid = _friction_row(i, C, inv_alpha, status, slopes, mu, slots, ints, inverse, work)
        else:
            continue
        held[i] = now
        ints[UPDATES] += 1
    if not valid:
        _rebuild(C, constants, status, slopes, mu, slots, owner, ints, inverse, work)
    _copy(status, held)


@njit(cache=True, error_model="numpy")
def _rescue(
    C: Any, constants: Any, status: Any, mu: Any, w: Any, u: Any, height: Any, spin: Any,
    ints: Any, normal: float, tangent: float, force: Any, trial: Any, start: Any,
) -> None:  # fmt: skip
    """Find a new guess of the active set by non-smooth Gauss-Seidel sweeps over the nodes.

    It converges slowly and without pivots, and is used only if the active set runs in a circle.
    `start` holds d and Δx, which change with the sweeps unless they are commanded.
    """
    m = status.size
    alpha = constants[ALPHA]
    beta = 1.0 - alpha
    _fill(trial, 0.0)
    for j in range(2 * m):
        if force[j] != 0.0:
            for k in range(2 * m):
                trial[k] += C[j, k] * force[j]
    d, dx = start[0], start[1]
    for _ in range(200):
        pressing, dragging = 0.0, 0.0
        stiffness_n, stiffness_t = 0.0, 0.0
        for i in range(m):
            gap = height[i] + alpha * trial[i] + beta * w[i] - d
            p = max(0.0, force[i] - gap / (alpha * C[i, i]))
            change = p - force[i]
            if change != 0.0:
                force[i] = p
                for k in range(2 * m):
                    trial[k] += C[i, k] * change
            slide = alpha * trial[m + i] + beta * u[i] - u[i] - spin[i] - dx
            free = force[m + i] - slide / (alpha * C[m + i, m + i])
            t = min(max(free, -mu[i] * p), mu[i] * p)
            change = t - force[m + i]
            if change != 0.0:
                force[m + i] = t
                for k in range(2 * m):
                    trial[k] += C[m + i, k] * change
            pressing += p
            dragging += t
            if p <= 0.0:
                status[i] = OPEN
            else:
                stiffness_n += 1.0 / (alpha * C[i, i])
                if t != free:
                    status[i] = SLIP_PLUS if free > 0.0 else SLIP_MINUS
                else:
                    status[i] = STICK
                    stiffness_t += 1.0 / (alpha * C[m + i, m + i])
        if ints[NORMAL_BY_FORCE] == 1:
            d += (normal - pressing) / max(stiffness_n, 1.0 / (alpha * C[0, 0]))
        if ints[TANGENT_BY_FORCE] == 1:
            lack = tangent - dragging - constants[MASS_DT2] * dx
            dx += lack / (stiffness_t + constants[MASS_DT2])
    start[0], start[1] = d, dx
    ints[RESCUES] += 1


@njit(cache=True, error_model="numpy")
def _set_modes(ints: Any, normal_by_force: int, tangent_by_force: int) -> None:
    if ints[NORMAL_BY_FORCE] != normal_by_force or ints[TANGENT_BY_FORCE] != tangent_by_force:
        ints[NORMAL_BY_FORCE], ints[TANGENT_BY_FORCE] = normal_by_force, tangent_by_force
        ints[VALID] = 0


@njit(cache=True, error_model="numpy")
def _look_at_all(
    C: Any, filtered: Any, status: Any, w: Any, u: Any, seen: Any, scalars: Any, ints: Any,
    trial: Any, loaded: Any,
) -> None:  # fmt: skip
    """Update the displacements of open nodes to the present step."""
    scalars[DRIFT] = 0.0
    _fill(seen, 0.0)
    if ints[AGAIN] == 0:
        return
    m, count = status.size, 0
    for j in range(2 * m):
        if filtered[j] != 0.0:
            loaded[count] = j
            count += 1
    _displacements(C, filtered, loaded, count, trial)
    for i in range(m):
        if status[i] == OPEN:
            w[i] = trial[i]
            u[i] = trial[m + i]
    ints[AGAIN] = 0


@njit(cache=True, error_model="numpy")
def _list(C: Any, held: Any, listed: Any, nodes: Any, was: Any, compact: Any, bound: Any) -> None:
    """List what `_again` needs of the active set of the inverse, close together in memory.

    These are the nodes in contact, those that stick first; the compliance by which their forces
    move the slipping ones; and how far a unit of each force moves an open node down at most.
    """
    m = held.size
    count = 0
    for sticking in (True, False):
        for i in range(m):
            if held[i] != OPEN and (held[i] == STICK) == sticking:
                nodes[count] = i
                count += 1
        if sticking:
            listed[STICKING] = count
    listed[TOUCHING] = count
    for j in range(listed[STICKING], count):
        source, target = C[m + nodes[j]], compact[j - listed[STICKING]]
        target[0], target[1] = 0.0, 0.0
        for k in range(count):
            target[2 + k] = source[nodes[k]]
            target[2 + count + k] = source[m + nodes[k]]
    _fill(bound, 0.0)
    for i in range(m):
        was[i] = held[i]
        if held[i] == OPEN:
            _raise(bound, C[i])
    listed[LISTED] = 1


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _raise(bound: Any, row: Any) -> None:
    """Compute bound = max(bound, |row|)."""
    for j in range(bound.size):
        bound[j] = max(bound[j], abs(row[j]))


@njit(cache=True, error_model="numpy")
def _pack(
    slots: Any, inverse: Any, listed: Any, nodes: Any, packed: Any, order: Any, answered: Any
) -> None:
    """Copy the inverse in the order d, Δx, p of the listed nodes, t of the sticking, t of the
    slipping ones, as far as a solution needs it."""
    count = listed[TOUCHING]
    order[0], order[1] = 0, 1
    for j in range(count):
        order[2 + j] = slots[0][nodes[j]]
        order[2 + count + j] = slots[1][nodes[j]]
    for q in range(2 + count + listed[STICKING]):
        source, target = inverse[order[q]], packed[q]
        for r in range(2 + 2 * count):
            target[r] = source[order[r]]
    for j in range(count):
        answered[j] = 0
    listed[PACKED] = 1


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _drift(bound: Any, force: Any, filtered: Any, alpha: float) -> float:
    """Return how far an open node can move in a step at most."""
    total = 0.0
    for j in range(force.size):
        total += bound[j] * abs(force[j] - filtered[j])
    return alpha * total


@njit(cache=True, error_model="numpy")
def _answer(
    k: int, count: int, sticking: int, slopes: Any, nodes: Any, packed: Any, compact: Any,
    answers: Any, slides: Any,
) -> None:  # fmt: skip
    """Compute the effect of a unit of additional tangential force at slipping node `k` on all
    unknowns, in the order of `_pack`, and on the slide of all slipping nodes."""
    needed, answer = 2 + count + sticking, answers[k]
    for q in range(needed):
        answer[q] = packed[q, needed + k]
    for j in range(sticking, count):
        answer[2 + count + j] = slopes[nodes[NODES, j]] * answer[2 + j]
    answer[needed + k] += 1.0
    _products(compact, nodes[COUNTING], count - sticking, answer, 2 + 2 * count, slides[k])


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _eliminate(A: Any, b: Any, n: int) -> bool:
    """Solve A[:n, :n] x = b[:n] in place, b becoming x; return False if A is singular."""
    for k in range(n):
        best = _pivot(A, k, n)
        if not abs(A[best, k]) > 1e-300:
            return False
        if best != k:
            for c in range(k, n):
                A[k, c], A[best, c] = A[best, c], A[k, c]
            b[k], b[best] = b[best], b[k]
        for r in range(k + 1, n):
            factor = A[r, k] / A[k, k]
            if factor != 0.0:
                for c in range(k + 1, n):
                    A[r, c] -= factor * A[k, c]
                b[r] -= factor * b[k]
    for k in range(n - 1, -1, -1):
        total = b[k]
        for c in range(k + 1, n):
            total -= A[k, c] * b[c]
        b[k] = total / A[k, k]
    return True


@njit(cache=True, error_model="numpy")
def _hold_back(
    alpha: float, spin: Any, u: Any, mu: Any, held: Any, slopes: Any, count: int, sticking: int,
    nodes: Any, packed: Any, compact: Any, x: Any, moved: Any, answers: Any, slides: Any,
    small: Any, work: Any,
) -> int:  # fmt: skip
    """Find those of the slipping nodes that stick in this step.

    Each of them bears a tangential force in addition to its friction that keeps it from sliding.
    `x` and `moved` are the solution with all of them slipping, and become the solution with those
    sticking that nodes[MARKED] marks. Return the number of sets tried, or 0 if none is consistent.
    """
    sliding, n = count - sticking, 2 + 2 * count
    x0, moved0, extra = work[13], work[14], work[15]
    _copy(x[:n], x0)
    _copy(moved[:sliding], moved0)
    marked, which, answered = nodes[MARKED], nodes[WHICH], nodes[ANSWERED]
    for tried in range(1, PATIENCE):
        k = 0
        for s in range(sliding):
            if marked[s] == 1:
                which[k] = s
                k += 1
        _copy(x0[:n], x)
        _copy(moved0[:sliding], moved)
        for a in range(k):
            if answered[which[a]] == 0:
                _answer(
                    which[a], count, sticking, slopes, nodes, packed, compact, answers, slides
                )  # fmt: skip
                answered[which[a]] = 1
        for a in range(k):
            i = nodes[NODES, sticking + which[a]]
            extra[a] = -(alpha * (moved0[which[a]] - u[i]) - spin[i] - x0[1])
            for c in range(k):
                small[a, c] = alpha * slides[which[c], which[a]] - answers[which[c], 1]
        if not _eliminate(small, extra, k):
            return 0
        for a in range(k):
            s = which[a]
            for q in range(n):
                x[q] += extra[a] * answers[s, q]
            for q in range(sliding):
                moved[q] += extra[a] * slides[s, q]
        changes = 0
        for s in range(sliding):
            j = sticking + s
            i = nodes[NODES, j]
            p, t = x[2 + j], x[2 + count + j]
            slide = alpha * (moved[s] - u[i]) - spin[i] - x[1]
            if p < -SET_TOLERANCE_N:
                return 0
            if marked[s] == 1:
                if abs(slide) > RESIDUAL_MM:
                    return 0
                if abs(t) > mu[i] * p + SET_TOLERANCE_N:
                    if (t > 0.0) != (held[i] == SLIP_PLUS):
                        return 0
                    marked[s] = 0
                    changes += 1
                continue
            if _against(slide, held[i], mu[i]):
                marked[s] = 1
                changes += 1
        if changes == 0:
            return tried
    return 0


@njit(cache=True, error_model="numpy")
def _slides_back(
    alpha: float, spin: Any, u: Any, mu: Any, held: Any, sticking: int, count: int, nodes: Any,
    dx: float, moved: Any,
) -> bool:  # fmt: skip
    """Return whether any slipping node slides against its friction."""
    for j in range(sticking, count):
        i = nodes[NODES, j]
        if _against(alpha * (moved[j - sticking] - u[i]) - spin[i] - dx, held[i], mu[i]):
            return True
    return False


@njit(cache=True, error_model="numpy")
def _again(
    C: Any, constants: Any, height: Any, spin: Any, normal: float, tangent: float, w: Any, u: Any,
    mu: Any, slopes: Any, status: Any, held: Any, force: Any, slots: Any, ints: Any, scalars: Any,
    inverse: Any, work: Any, filtered: Any, seen: Any, new_w: Any, new_u: Any, motion: Any,
    listed: Any, nodes: Any, packed: Any, compact: Any, bound: Any, answers: Any, slides: Any,
    small: Any,
) -> int:  # fmt: skip
    """Try the step with the inverse as it is; return the number of active sets tried.

    Return 0 if none is consistent, or if all displacements are due to be computed: then only
    `force` has changed.
    """
    n, m = ints[N], status.size
    if n == 2 or ints[VALID] == 0 or ints[AGAIN] >= LOOKED_AT_EVERY:
        return 0
    if listed[LISTED] == 0:
        _list(C, held, listed, nodes[NODES], nodes[HELD], compact, bound)
    if listed[PACKED] == 0:
        _pack(slots, inverse, listed, nodes[NODES], packed, nodes[ORDER], nodes[ANSWERED])
    count, sticking = listed[TOUCHING], listed[STICKING]
    needed, sliding = 2 + count + sticking, count - sticking
    alpha = constants[ALPHA]
    beta = 1.0 - alpha
    b, x, moved, lack = work[4], work[5], work[11], work[6]
    marked = nodes[MARKED]
    b[0], b[1] = normal, tangent
    base, extra = work[0], b[2 + count + sticking :]
    lacking, holding = False, False
    for j in range(count):
        i = nodes[NODES, j]
        b[2 + j] = (-height[i] - beta * w[i]) / alpha
        if j < sticking:
            b[2 + count + j] = (spin[i] + alpha * u[i]) / alpha
            continue
        if _outdated(status[i], mu[i], slopes[i], constants[MU_K], 1.0):
            return 0
        marked[j - sticking] = 1 if status[i] == STICK else 0
        holding = holding or status[i] == STICK
        lack[j - sticking] = _slope(held[i], mu[i]) - slopes[i]
        lacking = lacking or lack[j - sticking] != 0.0
    _products(packed, nodes[COUNTING], needed, b, needed, base)
    for s in range(sliding):
        lacks = marked[s] == 0
        extra[s] = lack[s] * force[nodes[NODES, sticking + s]] if lacks else 0.0
    tried, settled = 1, False
    for _ in range(FRICTION_ITERATIONS):
        if lacking and not holding:
            press = base[2 + sticking :]
            if not _correct_friction(
                packed, 2 + sticking, needed, press, lack, sliding, extra, work[13]
            ):
                return 0
        _copy(base[:needed], x)
        if lacking:
            _add_products(packed, 0, needed, needed, extra, sliding, x)
        for j in range(sticking, count):
            x[2 + count + j] = slopes[nodes[NODES, j]] * x[2 + j] + extra[j - sticking]
        if holding:
            _products(compact, nodes[COUNTING], sliding, x, n, moved)
            sets = _hold_back(
                alpha, spin, u, mu, held, slopes, count, sticking, nodes, packed, compact, x, moved,
                answers, slides, small, work,
            )  # fmt: skip
            if sets == 0:
                return 0
            tried += sets - 1
            worst = 0.0
            for s in range(sliding):
                wanted = lack[s] * x[2 + sticking + s] if marked[s] == 0 else 0.0
                worst = max(worst, abs(wanted - extra[s]))
                extra[s] = wanted
            settled = worst < FRICTION_TOLERANCE_N
        else:
            _products(compact, nodes[COUNTING], sliding, x, n, moved)
            holding = _slides_back(alpha, spin, u, mu, held, sticking, count, nodes, x[1], moved)
            settled = not holding
        if settled:
            break
    if not settled:
        return 0
    motion[0], motion[1] = x[0], x[1]
    _copy(w, new_w)
    _copy(u, new_u)
    for j in range(count):
        i = nodes[NODES, j]
        p, t, slide = x[2 + j], x[2 + count + j], 0.0
        now = held[i]
        if j >= sticking and marked[j - sticking] == 1:
            now = STICK
        if now == STICK:
            new_u[i] = u[i] + spin[i] + motion[1]
        else:
            new_u[i] = alpha * moved[j - sticking] + beta * u[i]
            slide = new_u[i] - u[i] - spin[i] - motion[1]
        if _wanted(i, now, C, alpha, mu[i], 0.0, slide, p, t) != now:
            return 0
        new_w[i] = motion[0] - height[i]
        force[i], force[m + i] = p, t
    drift = scalars[DRIFT] + _drift(bound, force, filtered, alpha)
    if not np.isfinite(drift):
        return 0  # a whole step refuses values that are not finite
    for i in range(m):
        if status[i] != OPEN or height[i] + w[i] - motion[0] > drift - seen[i]:
            continue
        new_w[i] = alpha * _dot(C[i], force) + beta * _dot(C[i], filtered)
        seen[i] = drift
        if height[i] + new_w[i] - motion[0] < -SET_TOLERANCE_MM:
            return 0
    for j in range(sticking, count):
        i = nodes[NODES, j]
        status[i] = STICK if marked[j - sticking] == 1 else held[i]
    scalars[DRIFT] = drift
    ints[AGAIN] += 1
    return tried


@njit(cache=True, error_model="numpy")
def _separated(
    constants: Any, height: Any, w: Any, u: Any, status: Any, force: Any, scalars: Any,
    ints: Any, tangent: float,
) -> float:  # fmt: skip
    """Make a step without normal force: nothing touches, the skin relaxes, the object moves
    freely."""
    beta = 1.0 - constants[ALPHA]
    nearest = np.inf
    for i in range(status.size):
        status[i] = OPEN
        w[i] *= beta
        u[i] *= beta
        nearest = min(nearest, height[i] + w[i])
    _fill(force, 0.0)
    ints[VALID] = 0
    scalars[D] = nearest
    return tangent / constants[MASS_DT2] if ints[TANGENT_BY_FORCE] == 1 else tangent


@njit(cache=True, error_model="numpy")
def _step(
    C: Any, constants: Any, height: Any, spin: Any, normal: float, tangent: float, w: Any, u: Any,
    mu: Any, slopes: Any, status: Any, held: Any, force: Any, slots: Any, owner: Any, ints: Any,
    inverse: Any, work: Any, new_w: Any, new_u: Any, motion: Any, loaded: Any, wanted: Any,
    rows: Any, small: Any, which: Any,
) -> int:  # fmt: skip
    """Solve one step; return the number of active sets tried, or -1 if none is consistent."""
    m = status.size
    alpha = constants[ALPHA]
    beta = 1.0 - alpha
    b, solution, trial = work[4], work[5], work[6]
    tried = 0
    for rescue in range(RESCUES_A_STEP + 1):
        if rescue > 0:
            _rescue(
                C, constants, status, mu, w, u, height, spin, ints, normal, tangent, force,
                trial[: 2 * m], motion,
            )  # fmt: skip
        for iteration in range(ITERATIONS):
            tried += 1
            if ints[NORMAL_BY_FORCE] == 1:
                _touch_somewhere(height, w, beta, status)
            _follow(C, constants, status, held, slopes, mu, slots, owner, ints, inverse, work)
            if ints[VALID] == 0:
                break
            _right_side(
                constants, w, u, height, spin, status, slots, ints, normal, tangent, b
            )  # fmt: skip
            needed = _needed(status, owner, ints[N], rows)
            settled = _solve(
                status, slopes, mu, slots, owner, ints, inverse, force, b, solution, rows, needed,
                small, work, which,
            )  # fmt: skip
            count = ints[N] - 2
            for k in range(count):
                loaded[k] = owner[k + 2, 1] + m * owner[k + 2, 0]
            _displacements(C, force, loaded, count, trial[: 2 * m])
            motion[0], motion[1] = solution[0], solution[1]
            changes, residual = 0, 0.0
            for i in range(m):
                new_w[i] = alpha * trial[i] + beta * w[i]
                new_u[i] = alpha * trial[m + i] + beta * u[i]
                gap = height[i] + new_w[i] - motion[0]
                slide = new_u[i] - u[i] - spin[i] - motion[1]
                if status[i] != OPEN:
                    residual = max(residual, abs(gap))
                if status[i] == STICK:
                    residual = max(residual, abs(slide))
                wanted[i] = _wanted(
                    i, status[i], C, alpha, mu[i], gap, slide, force[i], force[m + i]
                )
                if wanted[i] != status[i]:
                    changes += 1
            if not settled or not residual <= RESIDUAL_MM:
                # Without updates the inverse may still be older than the coefficients.
                if settled and ints[UPDATES] == 0:
                    break
                ints[VALID] = 0
                continue
            if changes == 0:
                return tried
            pick, seen = iteration % changes, 0
            for i in range(m):
                if wanted[i] != status[i]:
                    if iteration < PATIENCE or seen == pick:
                        status[i] = wanted[i]
                        if wanted[i] == OPEN:
                            force[i] = 0.0
                            force[m + i] = 0.0
                    seen += 1
    return -1


@njit(cache=True, error_model="numpy")
def _bonded(before: float, status: int, slide: float, constants: Any) -> float:
    """Return the share of a touching node's bonds that are whole after a step.

    Slip breaks them, exp(-1) of them remaining after the weakening distance. At rest, or creeping
    slower than the healing speed, broken bonds form again with the healing time. A slipping node
    that has stopped thereby gains friction, would be dragged backwards by it, and so sticks.
    """
    bonded = before
    if status != STICK:
        bonded *= np.exp(-slide / constants[D_C])
    if status == STICK or slide <= constants[REST]:
        bonded = 1.0 - (1.0 - bonded) * constants[BROKEN_LEFT]
    if bonded < NEGLIGIBLE_SHARE:
        return 0.0
    return bonded


@njit(cache=True, error_model="numpy")
def _touch_somewhere(height: Any, w: Any, beta: float, status: Any) -> None:
    """Make the highest node touch, because a pressed object touches at least one node."""
    highest = 0
    for i in range(status.size):
        if status[i] != OPEN:
            return
        if height[i] + beta * w[i] < height[highest] + beta * w[highest]:
            highest = i
    status[highest] = STICK


@njit(cache=True, error_model="numpy")
def advance(
    C: Any, x: Any, gap: Any, tributary: Any, ridge: Any, constants: Any, modes: Any,
    normal: Any, tangent: Any, rotation: Any,
    w: Any, u: Any, bonded: Any, mu: Any, slopes: Any, status: Any, held: Any, force: Any,
    filtered: Any, seen: Any, slots: Any, owner: Any, ints: Any, scalars: Any, inverse: Any,
    work: Any, listed: Any, nodes: Any, packed: Any, compact: Any, answers: Any, slides: Any,
    small: Any,
    rows: Any, summary: Any, ridge_forces: Any, statuses: Any, stresses: Any, forces: Any,
) -> int:  # fmt: skip
    """Advance the state by ``normal.size`` steps and return the number done; if fewer, the next
    one failed.

    `normal` contains F_n or d, `tangent` F_t or the object's position x, `rotation` the increments
    of its angle in rad, one value per step. A failed step leaves the state as it was before it.
    """
    m = status.size
    new_w, new_u, height, spin = work[7][:m], work[8][:m], work[9][:m], work[10][:m]
    trial, bound = work[6][: 2 * m], work[12][: 2 * m]
    alpha = constants[ALPHA]
    for k in range(nodes.shape[1]):
        nodes[COUNTING, k] = k
    motion = np.zeros(2)
    loaded = np.empty(2 * m, np.int64)
    wanted = np.empty(m, np.int8)
    radius_inverse = constants[CURVATURE]
    dt = constants[DT]
    before_status, before_force = status.copy(), force.copy()
    _set_modes(ints, modes[0], modes[1])
    for step in range(normal.size):
        _copy(status, before_status)
        _copy(force, before_force)
        centre = scalars[X] if modes[1] == 1 else tangent[step]
        drive = tangent[step] - scalars[X]
        if modes[1] == 1:
            drive = tangent[step] + constants[MASS_DT2] * dt * scalars[V]
        for i in range(m):
            off = x[i] - centre
            height[i] = gap[i] + 0.5 * radius_inverse * off * off
            spin[i] = 0.0
            if rotation[step] != 0.0:
                spin[i] = -rotation[step] * (1.0 / radius_inverse - 0.5 * radius_inverse * off**2)
        motion[0], motion[1] = scalars[D], 0.0 if modes[1] == 1 else drive
        if modes[0] == 0:
            motion[0] = normal[step]
        if modes[0] == 1 and normal[step] <= 0.0:
            _look_at_all(C, filtered, status, w, u, seen, scalars, ints, trial, loaded)
            new_x = _separated(
                constants, height, w, u, status, force, scalars, ints, drive
            )  # fmt: skip
            motion[0], motion[1] = scalars[D], new_x
            iterations, dissipated, area = 0, 0.0, 0.0
            _fill(bonded, 1.0)
            _fill(mu, constants[MU_S])
        else:
            iterations = _again(
                C, constants, height, spin, normal[step], drive, w, u, mu, slopes, status, held,
                force, slots, ints, scalars, inverse, work, filtered, seen, new_w, new_u, motion,
                listed, nodes, packed, compact, bound, answers, slides, small,
            )  # fmt: skip
            if iterations == 0:
                _look_at_all(
                    C, filtered, before_status, w, u, seen, scalars, ints, trial, loaded
                )  # fmt: skip
                updates, rebuilds = ints[UPDATES], ints[REBUILDS]
                iterations = _step(
                    C, constants, height, spin, normal[step], drive, w, u, mu, slopes, status, held,
                    force, slots, owner, ints, inverse, work, new_w, new_u, motion, loaded, wanted,
                    nodes[ORDER], small, nodes[WHICH],
                )  # fmt: skip
                if ints[UPDATES] != updates or ints[REBUILDS] != rebuilds:
                    listed[PACKED] = 0
                for i in range(m):
                    if held[i] != nodes[HELD, i]:
                        listed[LISTED], listed[PACKED] = 0, 0
            if iterations < 0:
                _copy(before_status, status)
                _copy(before_force, force)
                ints[VALID] = 0
                listed[LISTED], listed[PACKED] = 0, 0
                return step
            dissipated, area = 0.0, 0.0
            for i in range(m):
                slide = new_u[i] - u[i] - spin[i] - motion[1]
                if status[i] == OPEN:
                    bonded[i] = 1.0
                else:
                    area += tributary[i]
                    if status[i] != STICK:
                        dissipated -= force[m + i] * slide
                    bonded[i] = _bonded(bonded[i], status[i], abs(slide), constants)
                mu[i] = constants[MU_K] + (constants[MU_S] - constants[MU_K]) * bonded[i]
                w[i] = new_w[i]
                u[i] = new_u[i]
        scalars[D] = motion[0]
        scalars[V] = motion[1] / dt
        scalars[X] = scalars[X] + motion[1] if modes[1] == 1 else tangent[step]
        total_n, total_t = 0.0, 0.0
        count = ridge_forces.shape[2]
        for r in range(count):
            ridge_forces[step, 0, r] = 0.0
            ridge_forces[step, 1, r] = 0.0
        for i in range(m):
            statuses[step, i] = status[i]
            if status[i] != OPEN:
                ridge_forces[step, 0, ridge[i]] += force[i]
                ridge_forces[step, 1, ridge[i]] += force[m + i]
        for r in range(count):
            total_n += ridge_forces[step, 0, r]
            total_t += ridge_forces[step, 1, r]
        summary[step, OUT_D] = scalars[D]
        summary[step, OUT_FN] = total_n
        summary[step, OUT_X] = scalars[X]
        summary[step, OUT_FT] = total_t
        summary[step, OUT_DISSIPATED] = dissipated
        summary[step, OUT_AREA] = area
        summary[step, OUT_ITERATIONS] = iterations
        for j in range(2 * m):
            filtered[j] += alpha * (force[j] - filtered[j])
            if abs(filtered[j]) < FORGOTTEN_N:
                filtered[j] = 0.0
        _products(rows, nodes[COUNTING], rows.shape[0], force, 2 * m, stresses[step])
        if forces.shape[0] > 0:
            _copy(force, forces[step])
    return int(normal.size)
