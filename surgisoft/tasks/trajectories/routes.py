"""Routes over the points of several paths, one path after another, and progress along a route."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.treatment import Stretch


@dataclass(frozen=True, eq=False)
class RouteProgress:
    """The route of each of B episodes, and how far it is followed."""

    route: Tensor
    """(B, R) int64: numbers of the points of the paths, in the order of the episode."""
    done: Tensor
    """(B,) int64: steps by which the reference has moved; after R steps it begins again."""
    fired: Tensor
    """(B,) bool: the beam was on in the last step."""

    @property
    def steps(self) -> int:
        """R, steps of the whole route."""
        return self.route.shape[1]

    @property
    def share(self) -> Tensor:
        """(B,) 0..1: share of the route that is followed."""
        return (self.done / self.steps).clamp(max=1.0)

    def point(self, ahead: int = 0) -> Tensor:
        """(B,) int64: number of the point that is the reference `ahead` steps further on."""
        place = (self.done + ahead).remainder(self.steps)
        return self.route.gather(1, place[:, None])[:, 0]

    def after(self, fired: Tensor, moved: Tensor | None = None) -> RouteProgress:
        """The route one step later, in which the beam was on where fired (B,) bool is set.

        moved: (B,) bool, where the reference moved; None: where the beam was on.
        """
        moved = fired if moved is None else moved
        return replace(self, done=self.done + moved, fired=fired)


def draw_route(
    stream: Stream, stretches: Sequence[Stretch], overlap: int
) -> tuple[Stream, RouteProgress]:
    """Draw a route over all stretches, in their order, for each of the (B,) random number streams.

    A closed stretch begins anywhere, goes round in either direction, and passes its first `overlap`
    points twice. An open one begins at either end.
    """
    stream, draw = stream.uniform(0.0, 1.0, 2, len(stretches))
    parts = []
    for number, stretch in enumerate(stretches):
        start, way = draw[:, 0, number], torch.where(draw[:, 1, number] < 0.5, 1, -1)
        if stretch.closed:
            more = torch.arange(stretch.count + overlap, device=way.device)
            first = (start * stretch.count).long().clamp(max=stretch.count - 1)
            place = (first[:, None] + way[:, None] * more).remainder(stretch.count)
        else:
            along = torch.arange(stretch.count, device=way.device)
            place = along.where(way[:, None] > 0, stretch.count - 1 - along)
        parts.append(stretch.first + place)
    done = torch.zeros_like(stream.count)
    return stream, RouteProgress(torch.cat(parts, 1), done, done > 0)


def route_steps(stretches: Sequence[Stretch], overlap: int) -> int:
    """Steps of a route over all stretches, see `draw_route`."""
    return sum(each.count + (overlap if each.closed else 0) for each in stretches)
