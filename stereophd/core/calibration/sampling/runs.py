"""Runs of a sampler: steps over a frozen state of arrays, until it is done.

Random numbers of a step depend on the seed and the number of the step alone, so that a run continued from any state
gives the same result as an uninterrupted one.
"""

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

State = TypeVar("State")
Info = TypeVar("Info")
Info_co = TypeVar("Info_co", covariant=True)


class Sampler(Protocol[State, Info_co]):
    """The sampler of one problem: a state holds what the next step needs, an info the diagnostics of a step."""

    def init(self) -> State:
        """Draw the particles that it begins with."""

    def done(self, state: State) -> bool:
        """Whether the particles represent the posterior."""

    def step(self, state: State) -> tuple[State, Info_co]:
        """Return the next state, and what happened on the way."""

    def progress(self, state: State) -> tuple[int, int]:
        """Return how much is done, and of how much."""


def run(
    sampler: Sampler[State, Info],
    resume: tuple[State, Sequence[Info]] | None = None,
    after_step: Callable[[State, Sequence[Info]], None] | None = None,
) -> tuple[State, list[Info]]:
    """Run a sampler to its end; return the last state, and the infos of all steps.

    `resume` has the state and the infos that `after_step` was given: the run continues there, to the same result.
    `after_step` serves progress and checkpoints; an exception that it raises ends the run.
    """
    state, history = (sampler.init(), list[Info]()) if resume is None else (resume[0], list(resume[1]))
    while not sampler.done(state):
        state, info = sampler.step(state)
        history.append(info)
        if after_step is not None:
            after_step(state, history)
    return state, history
