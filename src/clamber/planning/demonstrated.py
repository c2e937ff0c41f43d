"""The steps of a sequence in order: one is repaired, or left out at a cost.

Each step is planned from the keyframe before it. Where a step fails because of where an
earlier contact lies, that contact is put where the step would have liked it, and
planning goes on from there; where nothing helps, the step is left out. A sequence is
gone through with several weights of the keyframes, which lead it to other contacts,
from which there may be a way: the first with the fewest steps left out is found.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from clamber.contact.contact import Contact
from clamber.contact.steps import Seeds, Step
from clamber.planning.records import PlanOptions, Route
from clamber.planning.search import Search
from clamber.step.change import Change, Failure
from clamber.step.ik import IK
from clamber.step.posture import Keyframe
from clamber.step.transition import eased_contacts, margins_of

# Factors on the weights of the keyframes, by what is tried first.
VARIATIONS: tuple[Mapping[str, float], ...] = (
    {},
    {"stability_weight": 2.0},
    {"direction_weight": 2.0},
    {"reference_weight": 2.0},
    {"reference_weight": 0.5},
    {"stability_weight": 4.0},
    {"balance_margin": 1.4},
)
LEFT_OUT, OTHER_WEIGHTS = 1.0, 0.01  # price of a step, and of the next weights
MAX_REPAIRS = 4  # earlier contacts that may be put elsewhere for a later step's sake


def search_steps(
    ik: IK, start: Keyframe, steps: Sequence[Step], options: PlanOptions
) -> tuple[Route, PlanOptions]:
    """Steps in order in a search of their own, and the options that led farthest."""
    return follow_steps(Search(ik, options), start, steps)


def follow_steps(
    search: Search,
    start: Keyframe,
    steps: Sequence[Step],
    proposer: str = "demonstrated",
    variations: Sequence[Mapping[str, float]] = VARIATIONS,
) -> tuple[Route, PlanOptions]:
    """The route that leaves out the fewest of some steps, and with which options.

    Args:
        search: That tries them.
        start: The keyframe to begin from.
        steps: In order.
        proposer: Whose steps they are.
        variations: Of the weights, by what is tried first.
    """
    lines = [
        _Line(
            proposer=proposer,
            options=varied(search.options, factors),
            weights=i,
            start=start,
            steps=tuple(steps),
        )
        for i, factors in enumerate(variations)
    ]
    line, failure = search.best_first(lines)
    assert line is not None  # steps can be left out: it ends, or is cut short
    failures = tuple(line.failures.values())
    if failure is not None:
        failures = (*failures, failure)
    arrived = not failures
    changes = tuple(line.changes)
    route = Route(start=start, changes=changes, failures=failures, arrived=arrived)
    return route, line.options


def varied(options: PlanOptions, factors: Mapping[str, float]) -> PlanOptions:
    """The options with other weights of the keyframes."""
    weights = {k: f * getattr(options.keyframe, k) for k, f in factors.items()}
    return replace(options, keyframe=replace(options.keyframe, **weights))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Line:
    """An entry of the search: the steps with some weights, as far as it has come.

    Attributes:
        weights: Which of the variations.
        steps: As they are wanted now; `k` is the next one.
        changes: That were made, and `done`: the step that each of them makes.
        failures: By step, why it is left out.
        mended: How often earlier contacts were put elsewhere.
    """

    proposer: str
    options: PlanOptions
    weights: int
    start: Keyframe
    steps: tuple[Step, ...]
    k: int = 0
    changes: tuple[Change, ...] = ()
    done: tuple[int, ...] = ()
    failures: Mapping[int, Failure] = field(default_factory=dict)
    mended: int = 0

    @property
    def price(self) -> float:
        """Steps left out first, then the weights."""
        return LEFT_OUT * len(self.failures) + OTHER_WEIGHTS * self.weights

    @property
    def ended(self) -> bool:
        """Whether it has come to its last step."""
        return self.k == len(self.steps)

    @property
    def idle(self) -> bool:
        """Never: steps can be left out."""
        return False

    @property
    def route(self) -> Route:
        """The plan so far."""
        return Route(start=self.start, changes=self.changes)

    def look(self, search: Search) -> _Line:
        """The line where it has ended or become dearer, or time is up."""
        line = self
        while line.price == self.price and not line.ended and not search.late:
            line = line._next(search)
        return line

    def after(self, found: _Line) -> list[_Line]:
        """The line as it was found."""
        return [found]

    def _next(self, search: Search) -> _Line:
        """The line after its next step, or before one that is to be mended."""
        found = self._change(search, self.route.end, self.steps[self.k])
        if isinstance(found, Change):
            return self._after(search, found)
        return self._mend(search, found)

    def _change(self, search: Search, before: Keyframe, step: Step) -> Change | Failure:
        n, note = len(self.steps), str(step)
        if search.part or self.weights:
            note = f"step {self.k + 1} of {n}: {note}"
        if self.weights:
            note = f"weights {self.weights + 1} of {len(VARIATIONS)}, {note}"
        search.report("plan", self.k / n, note)
        return search.change(self.proposer, before, step, self.options)

    def _after(self, search: Search, change: Change) -> _Line:
        """With a change more; earlier ones anew where that leaves more room."""
        line = replace(
            self,
            k=self.k + 1,
            done=(*self.done, self.k),
            changes=(*self.changes, change),
        )
        if self.mended < MAX_REPAIRS and change.margin < margins_of(search.ik.world)[0]:
            return line._roomier(search) or line
        return line

    def _mend(self, search: Search, failure: Failure) -> _Line:
        """Back at the first contact that is moved, or the step left out."""
        step, better = self.steps[self.k], None
        if self.mended < MAX_REPAIRS:
            better = next(repairs(search.ik, self.route, step), None)
        if better is None:
            failures = {**self.failures, self.k: failure}
            return replace(self, k=self.k + 1, failures=failures)
        places, seeds = better
        steps, j = list(self.steps), min(places)
        steps[self.k] = replace(step, seeds=seeds)
        for i, contact in places.items():
            steps[self.done[i]] = _placed(steps[self.done[i]], contact)
        k = self.done[j]
        return replace(
            self,
            steps=tuple(steps),
            k=k,
            changes=self.changes[:j],
            done=self.done[:j],
            failures={i: f for i, f in self.failures.items() if i < k},
            mended=self.mended + 1,
        )

    def _roomier(self, search: Search) -> _Line | None:
        """The last step with the largest margin, earlier contacts put elsewhere.

        None where that does not help, or costs another step its margin.
        """
        last = self.steps[self.done[-1]]
        before = replace(self, changes=self.changes[:-1]).route
        wide = margins_of(search.ik.world)[0]
        least = [*(c.margin for c in before.changes), wide]
        for places, seeds in repairs(search.ik, before, last, margin=wide):
            j, steps = min(places), list(self.steps)
            steps[self.done[-1]] = replace(last, seeds=seeds)
            for i, contact in places.items():
                steps[self.done[i]] = _placed(steps[self.done[i]], contact)
            changes = list(self.changes[:j])
            for i in range(j, len(self.done)):
                key = changes[-1].keyframe if changes else self.start
                found = self._change(search, key, steps[self.done[i]])
                if isinstance(found, Failure) or found.margin < least[i]:
                    break
                changes.append(found)
            else:
                return replace(
                    self,
                    steps=tuple(steps),
                    changes=tuple(changes),
                    mended=self.mended + 1,
                )
        return None


def _placed(step: Step, contact: Contact) -> Step:
    """The step, its contact made there and nowhere else."""
    return replace(step, makes=contact, fixed=True)


def repairs(
    ik: IK, route: Route, step: Step, *, margin: float | None = None
) -> Iterator[tuple[dict[int, Contact], Seeds]]:
    """Earlier contacts, by their change, moved so that `step` becomes feasible.

    Looks at one contact after the other, the last one first, and then at all at once.

    Yields:
        By index of the change, the contact at its better place, and the posture that
        `step` then goes through.
    """
    standing_on = {c.surface for c in route.end.stance} - set(step.breaks)
    made: dict[str, int] = {}
    for j in range(len(route.changes) - 1, -1, -1):
        new = route.changes[j].step.makes
        if new is not None and new.surface in standing_on and new.surface not in made:
            made[new.surface] = j
    for surfaces in (*([x] for x in made), list(made)):
        eased = eased_contacts(ik, route.end, step, surfaces, margin=margin)
        if eased is not None:
            contacts, seeds = eased
            yield {made[c.surface]: c for c in contacts}, seeds
