"""Pieces of all cameras sorted into people: as much evidence within each as can be, and nobody twice at once in a camera."""

from __future__ import annotations

import numpy as np

from indexing.calibrate.people.options import AssociationOptions
from indexing.calibrate.people.tracklets import Booleans, Floats, Integers


def clustered(scores: Floats, conflicts: Booleans, options: AssociationOptions, begins: Floats | None = None) -> Integers:
    """Correlation clustering with conflicts: scores ``(n, n)``, conflicts ``(n, n)``, begins ``(n,)`` -> ``(n,)``."""
    labels = _joined(scores, conflicts)
    for _ in range(options.clusters.sweeps):
        labels = _improved(scores, conflicts, labels, options)
        crossed = None if begins is None else _crossed(scores, conflicts, labels, begins, options)
        if crossed is None:
            break
        labels = crossed
    return _ordered(scores, labels)


def _joined(scores: Floats, conflicts: Booleans) -> Integers:
    """Greedy: the two groups with most evidence between them are one, until none is left that gains."""
    count = len(scores)
    labels = np.arange(count, dtype=np.int64)
    if not count:
        return labels
    sums, barred = scores.astype(np.float64).copy(), conflicts.copy()
    np.fill_diagonal(barred, True)
    masked = np.where(barred, -np.inf, sums)
    best = masked.argmax(1)
    top = masked[np.arange(count), best]
    while True:
        a = int(top.argmax())
        if not top[a] > 0:
            return labels
        b = int(best[a])
        a, b = min(a, b), max(a, b)
        labels[labels == b] = a
        sums[a] += sums[b]
        sums[:, a] = sums[a]
        barred[a] |= barred[b]
        barred[:, a] = barred[a]
        barred[b], barred[:, b], barred[a, a] = True, True, True
        masked[a] = np.where(barred[a], -np.inf, sums[a])
        masked[:, a] = masked[a]
        masked[b], masked[:, b] = -np.inf, -np.inf
        stale = (best == a) | (best == b)
        stale[[a, b]] = True
        better = masked[:, a] > top
        best[better], top[better] = a, masked[better, a]
        for row in np.flatnonzero(stale & ~better):
            best[row] = masked[row].argmax()
            top[row] = masked[row, best[row]]


def _improved(scores: Floats, conflicts: Booleans, labels: Integers, options: AssociationOptions) -> Integers:
    """Pieces change groups, with all that are in their way, while the sum rises."""
    labels = _compact(labels)
    for _ in range(options.clusters.sweeps):
        moved = False
        for piece in range(len(labels)):
            chosen = _best_move(scores, conflicts, labels, piece, options)
            if chosen is not None:
                labels = chosen
                moved = True
        if not moved:
            break
    return labels


def _best_move(scores: Floats, conflicts: Booleans, labels: Integers, piece: int, options: AssociationOptions) -> Integers | None:
    """The labels after the exchange, begun by one piece, that gains most; None where none gains."""
    own = int(labels[piece])
    groups = int(labels.max()) + 1
    reach = np.bincount(labels, weights=scores[piece], minlength=groups + 1)
    found, most = None, options.clusters.gain
    for other in range(groups + 1):
        if other == own or (other < groups and reach[other] <= 0 and not _blocked(conflicts, labels, piece, other)):
            continue
        changed, gain = exchanged(scores, conflicts, labels, piece, other)
        if gain > most:
            found, most = changed, gain
    return None if found is None else _compact(found)


def _blocked(conflicts: Booleans, labels: Integers, piece: int, other: int) -> bool:
    return bool((conflicts[piece] & (labels == other)).any())


def exchanged(scores: Floats, conflicts: Booleans, labels: Integers, piece: int, other: int) -> tuple[Integers, float]:
    """Labels after a piece went to another group, those in conflict with it to its own, those with these back, and so on."""
    own = int(labels[piece])
    within = np.flatnonzero((labels == own) | (labels == other))
    local = labels[within] == other
    against = conflicts[np.ix_(within, within)]
    chain = np.zeros(len(within), dtype=bool)
    front = within == piece
    while front.any():
        chain |= front
        front = against[front].any(0) & ~chain & (local != local[front][0])
    values = scores[np.ix_(within, within)]
    # what is between those that move and those that stay: together before is apart after, and the other way round
    between = values[np.ix_(chain, ~chain)]
    together = local[chain][:, None] == local[~chain][None]
    gain = float(between[~together].sum() - between[together].sum())
    out = labels.copy()
    moving = within[chain]
    out[moving] = np.where(labels[moving] == own, other, own)
    return out, gain


def _crossed(scores: Floats, conflicts: Booleans, labels: Integers, begins: Floats, options: AssociationOptions) -> Integers | None:
    """Labels after the exchange of what two groups are from a moment on that gains most; None where none gains."""
    labels = _compact(labels)
    found, most = None, options.clusters.gain
    groups = int(labels.max()) + 1 if len(labels) else 0
    for a in range(groups):
        for b in range(a + 1, groups):
            within = np.flatnonzero((labels == a) | (labels == b))
            within = within[np.argsort(begins[within], kind="stable")]
            own = labels[within] == a
            values, against = scores[np.ix_(within, within)], conflicts[np.ix_(within, within)]
            signed = np.where(own[:, None] == own[None], -values, values)
            barred = against & (own[:, None] != own[None])
            for cut in range(len(within)):  # the first part is before it
                gain = float(signed[:cut, cut:].sum()) if cut else _together(values, against, own)
                if gain > most and not barred[:cut, cut:].any():
                    found, most = (within[cut:] if cut else within[own], a, b), gain
    if found is None:
        return None
    moving, a, b = found
    out = labels.copy()
    out[moving] = a + b - labels[moving]
    return _compact(out)


def _together(values: Floats, against: Booleans, own: Booleans) -> float:
    """What one group of two gains, whenever their pieces begin."""
    apart = np.ix_(own, ~own)
    return -np.inf if against[apart].any() else float(values[apart].sum())


def _compact(labels: Integers) -> Integers:
    return np.unique(labels, return_inverse=True)[1].astype(np.int64)


def _ordered(scores: Floats, labels: Integers) -> Integers:
    """Groups by their evidence, most first; of equals the one with the first piece."""
    if not len(labels):
        return labels
    labels = _compact(labels)
    one = np.zeros((len(labels), int(labels.max()) + 1))
    one[np.arange(len(labels)), labels] = 1.0
    within = np.einsum("pg,pq,qg->g", one, scores, one) / 2
    first = np.array([int(np.flatnonzero(labels == group)[0]) for group in range(one.shape[1])])
    order = np.lexsort((first, -np.round(within, 9)))
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    return place[labels]
