"""GP: which of the doubtful candidates are true, told by epipolar geometry (paper, Sec. III-C1)."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from sgam_core.geometry import mean_residual
from sgam_core.options import GeometryOptions, PredictionOptions
from sgam_core.types import Area, AreaMatch, AreaState, Matches, TwoViewModel

Estimate = Callable[[Matches], TwoViewModel | None]
"""Robust geometry of matches with the pair's cameras and options bound."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class MatchedArea:
    """An area match and the point matches inside it, in image pixels."""

    area: AreaMatch
    matches: Matches

    def resolved(self, state: AreaState, reason: str = "") -> MatchedArea:
        """The same area match in another state."""
        return replace(self, area=replace(self.area, state=state, reason=reason))


def predict(
    confident: Sequence[MatchedArea],
    doubtful: Sequence[Sequence[MatchedArea]],
    estimate: Estimate,
    geometry: GeometryOptions,
    options: PredictionOptions,
) -> list[MatchedArea]:
    """Every candidate of every doubtful group, kept (and `predicted`) or unresolved with the reason.

    With confident matches their consensus geometry scores each candidate on its own and a rectangular assignment
    chooses; without, small groups are enumerated as the paper does.

    # Differs from the paper: it enumerates always, H!/(H-R)! assignments.
    """
    tried = [[candidate for candidate in group if candidate.area.state is not AreaState.SKIPPED] for group in doubtful]
    passed_over = [c for group in doubtful for c in group if c.area.state is AreaState.SKIPPED]
    if not options.enabled:
        return passed_over + [c.resolved(AreaState.UNRESOLVED, "GP is off") for group in tried for c in group]
    anchor = estimate(Matches.concatenate([area.matches for area in confident])) if confident and tried else None
    judged = []
    for group in tried:
        if anchor is not None:
            costs = [_cost(anchor, candidate, geometry) for candidate in group]
            judged += _assign(group, costs, geometry.tau, options)
        else:
            judged += _enumerate(group, estimate, geometry, options)
    return passed_over + judged


def _cost(model: TwoViewModel | None, candidate: MatchedArea, geometry: GeometryOptions) -> float:
    """D(F, P): mean capped residual, the cap itself without enough matches or a model."""
    if model is None or len(candidate.matches) < geometry.min_matches:
        return geometry.tau
    return mean_residual(model.F, candidate.matches, geometry.tau)


def _assign(
    group: Sequence[MatchedArea], costs: Sequence[float], tau: float, options: PredictionOptions
) -> list[MatchedArea]:
    """The cheapest one-to-one choice, where leaving an area alone costs `dummy_cost` tau."""
    areas0, areas1 = _sides(group)
    cost = {(c.area.area0, c.area.area1): value for c, value in zip(group, costs, strict=True)}
    dummy = options.dummy_cost * tau
    table = np.full((len(areas0) + len(areas1),) * 2, dummy)
    table[: len(areas0), : len(areas1)] = np.inf
    table[len(areas0) :, len(areas1) :] = 0.0
    for (area0, area1), value in cost.items():
        # A match replaces two dummies: it must cost less than one of them.
        table[areas0.index(area0), areas1.index(area1)] = 2 * value if value < dummy else np.inf
    table[np.isinf(table)] = 1e6
    rows, columns = linear_sum_assignment(table)
    chosen = {
        (areas0[i], areas1[j])
        for i, j in zip(rows.tolist(), columns.tolist(), strict=True)
        if i < len(areas0) and j < len(areas1) and table[i, j] < 1e6
    }
    return [_judge(candidate, chosen, cost, options) for candidate in group]


def _judge(
    candidate: MatchedArea,
    chosen: set[tuple[Area, Area]],
    cost: dict[tuple[Area, Area], float],
    options: PredictionOptions,
) -> MatchedArea:
    """Keep a chosen candidate unless another choice for one of its areas is about as good."""
    area0, area1 = key = (candidate.area.area0, candidate.area.area1)
    if key not in chosen:
        return candidate.resolved(AreaState.UNRESOLVED, f"GP: not the consistent choice (cost {cost[key]:.2f})")
    rivals = [value for (a, b), value in cost.items() if (a == area0) != (b == area1)]
    if rivals and min(rivals) < cost[key] * (1 + options.min_lead) + 1e-9:
        return candidate.resolved(
            AreaState.UNRESOLVED,
            f"GP: ambiguous, costs {cost[key]:.2f} and {min(rivals):.2f} differ by less than {options.min_lead:.0%}",
        )
    return replace(candidate, area=replace(candidate.area, predicted=True))


def _enumerate(
    group: Sequence[MatchedArea], estimate: Estimate, geometry: GeometryOptions, options: PredictionOptions
) -> list[MatchedArea]:
    """The paper's predictor: the set of matches whose geometries agree best with each other (Eq. 5 to 8).

    # Differs from the paper: an area can stay alone at `dummy_cost`, so that no set is forced to be complete.
    """
    areas0, areas1 = _sides(group)
    if max(len(areas0), len(areas1)) > options.max_enumerated:
        reason = f"GP: {len(areas0)} x {len(areas1)} doubtful areas without a confident match (max_enumerated)"
        return [candidate.resolved(AreaState.UNRESOLVED, reason) for candidate in group]
    models = [estimate(c.matches) if len(c.matches) >= geometry.min_matches else None for c in group]
    cross = np.array([[_cost(model, candidate, geometry) for candidate in group] for model in models])
    dummy = options.dummy_cost * geometry.tau
    number = min(len(areas0), len(areas1))

    def total(rows: Sequence[int]) -> float:
        inside = cross[np.ix_(rows, rows)].mean() * len(rows) if rows else 0.0
        return float(inside + dummy * (number - len(rows)))

    best = min(_matchings(group), key=lambda rows: (total(rows), rows))
    cost = {(c.area.area0, c.area.area1): float(cross[[*best, k]][:, k].mean()) for k, c in enumerate(group)}
    chosen = {(group[k].area.area0, group[k].area.area1) for k in best}
    return [_judge(candidate, chosen, cost, options) for candidate in group]


def _matchings(group: Sequence[MatchedArea]) -> Iterable[tuple[int, ...]]:
    """All sets of candidates (as indices) in which no area occurs twice."""
    limit = min(map(len, _sides(group)))
    for size in range(limit + 1):
        for rows in itertools.combinations(range(len(group)), size):
            if all(len({side(group[k].area) for k in rows}) == size for side in (_area0, _area1)):
                yield rows


def _area0(match: AreaMatch) -> Area:
    return match.area0


def _area1(match: AreaMatch) -> Area:
    return match.area1


def _sides(group: Sequence[MatchedArea]) -> tuple[list[Area], list[Area]]:
    """The distinct areas of both images, in order of appearance."""
    return list(dict.fromkeys(_area0(c.area) for c in group)), list(dict.fromkeys(_area1(c.area) for c in group))
