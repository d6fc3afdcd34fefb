"""The triangle that each sample of many views sees: a z-buffer of torch operations.

Triangles become rows of samples, and rows become fragments, by repeat_interleave. A row holds exactly the samples whose
centres lie in the triangle, half open to the right and below. So triangles with a common edge neither overlap nor part.
All fragments meet in one scatter_reduce: the nearest has the largest 1/z, whose bits are the high half of an integer.
The low half names the triangle, so that the first is seen of equally near ones, in whatever order they come.

Floor: a fragment moves 8 bytes of address, 8 of key and 16 of the atomic maximum; the operations one by one move 300.
The host waits twice for each chunk: for the number of rows, and for the number of fragments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from training.data.fusing import fused
from training.meshes.pack import Meshes, ResidentMeshes

NEAR = 0.05  # scene units: triangles with a corner nearer to the camera are left out
_LAST = (1 << 32) - 1  # no triangle has this number
_FRAGMENTS = 1 << 24  # of one scatter: about a gigabyte for a moment
Holes = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class DrawList:
    """K objects to draw in N views, sorted by view; numbers of triangles and vertices count over the whole list.

    Attributes:
        view: int64 [K], the view of each draw.
        first_vertex, vertices: int64 [K], an object's first vertex in the pack, and how many it has.
        first_triangle, triangles: int64 [K], likewise.
        first_material: int64 [K].
        list_vertex, list_triangle: int64 [K], numbers of its first vertex and triangle in the list.
        views: N.
        total_vertices, total_triangles: Of all draws.
        has_holes: Whether a material of an object has holes.
    """

    view: Tensor
    first_vertex: Tensor
    vertices: Tensor
    first_triangle: Tensor
    triangles: Tensor
    first_material: Tensor
    list_vertex: Tensor
    list_triangle: Tensor
    views: int
    total_vertices: int
    total_triangles: int
    has_holes: bool


def list_draws(meshes: Meshes, objects: np.ndarray, view: np.ndarray, views: int) -> DrawList:
    """Return the list, on the host, of objects [K] drawn in views [K], which ascend."""
    first_vertex, first_triangle = meshes.vertices[objects], meshes.triangles[objects]
    vertices = meshes.vertices[objects + 1] - first_vertex
    triangles = meshes.triangles[objects + 1] - first_triangle
    numbers = {
        "view": view,
        "first_vertex": first_vertex,
        "vertices": vertices,
        "first_triangle": first_triangle,
        "triangles": triangles,
        "first_material": meshes.materials[objects],
        "list_vertex": np.cumsum(vertices) - vertices,
        "list_triangle": np.cumsum(triangles) - triangles,
    }
    return DrawList(
        **{name: torch.from_numpy(values.astype(np.int64)) for name, values in numbers.items()},
        views=views,
        total_vertices=int(vertices.sum()),
        total_triangles=int(triangles.sum()),
        has_holes=meshes.has_holes(objects),
    )


@dataclass(frozen=True)
class Projected:
    """The triangles of a draw list on the sample grids of their views.

    Attributes:
        points: [NV,3], x and y of vertices in samples, and 1/z; for an orthographic camera a distance from the far
            side. Not above 0: behind the camera.
        draw: int64 [NT], the draw of each triangle.
        corners: int64 [NT,3], rows of points.
        triangles: int64 [NT], numbers of the triangles in the pack.
    """

    points: Tensor
    draw: Tensor
    corners: Tensor
    triangles: Tensor


def project(
    meshes: ResidentMeshes, draws: DrawList, to_camera: Tensor, intrinsics: Tensor, orthographic: bool = False
) -> Projected:
    """Return the triangles of a list as its cameras see them.

    Args:
        to_camera: [K,3,4], an object's axes to those of the camera (OpenCV).
        intrinsics: [N,4], (fx, fy, cx, cy) in samples.
        orthographic: Take x and y for what they are, and -z for 1/z: objects are to lie at negative z.
    """
    of_vertex, vertex = _expanded(draws.vertices, draws.first_vertex, draws.list_vertex, draws.total_vertices)
    matrix, camera = to_camera[of_vertex], intrinsics[draws.view[of_vertex]]
    x, y, z = ((matrix[..., :3] * meshes.positions[vertex][:, None]).sum(-1) + matrix[..., 3]).unbind(-1)
    near = -z if orthographic else torch.where(z > NEAR, 1 / z, -1)
    factor = torch.ones_like(near) if orthographic else near
    points = torch.stack([x * factor * camera[:, 0] + camera[:, 2], y * factor * camera[:, 1] + camera[:, 3], near], -1)
    draw, triangles = _expanded(draws.triangles, draws.first_triangle, draws.list_triangle, draws.total_triangles)
    corners = meshes.corners[triangles] + draws.list_vertex[draw][:, None]
    return Projected(points, draw, corners, triangles)


def _expanded(counts: Tensor, first: Tensor, begin: Tensor, total: int) -> tuple[Tensor, Tensor]:
    """Return for each of `total` elements the number of its run, and its place: first[run], first[run] + 1, ..."""
    numbers = torch.arange(total, device=counts.device)
    run = torch.repeat_interleave(counts, output_size=total)
    return run, numbers + (first - begin)[run]


def rasterize(
    points: Tensor, view: Tensor, views: int, size: tuple[int, int], holes: Holes | None = None, compiled: bool = False
) -> tuple[Tensor, Tensor]:
    """Return the nearest triangle of each sample, int64 [N*H*W], -1 for none, and its 1/z, 0 for none.

    Args:
        points: [NT,3,3], corners of triangles as in Projected.
        view: int64 [NT], the view of each triangle.
        size: H, W.
        holes: Says of fragments, by triangle and sample int64 [F], which of them are holes; None: there are no holes.
        compiled: Use a few kernels that torch.compile makes.
    """
    height, width = size
    buffer = torch.zeros(views * height * width, dtype=torch.int64, device=view.device)
    for triangle, sample, key in _Rows(points, view, size).fragments(fused(_fragments, compiled, dynamic=True)):
        if holes is not None:
            key = torch.where(holes(triangle, sample), 0, key)
        buffer.scatter_reduce_(0, sample, key, "amax")
    near = (buffer >> 32).to(torch.int32).view(torch.float32)
    return torch.where(buffer > 0, _LAST - (buffer & _LAST), -1), near


def _fragments(
    row: Tensor, before: int, begins: Tensor, near: Tensor, step: Tensor, triangle: Tensor, sample: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return triangle, sample and key of fragments [F] of rows.

    Args:
        row: int64 [F].
        before: Number of fragments before these.
        begins: int64 [R], number of each row's first fragment.
        near, step, triangle, sample: Of the rows, as _Rows has them.
    """
    along = torch.arange(len(row), device=row.device) + before - begins[row]
    bits = (near[row] + step[row] * along).view(torch.int32).long()
    chosen = triangle[row]
    return chosen, sample[row] + along, (bits << 32) + (_LAST - chosen)


class _Rows:
    """The rows of samples whose centres triangles hold.

    Args:
        points: [NT,3,3], corners of triangles, as in Projected.
    """

    def __init__(self, points: Tensor, view: Tensor, size: tuple[int, int]) -> None:
        height, width = size
        first, second, third = _sorted_by_y(points)
        top, bottom = (_first_centre(point[:, 1], height) for point in (first, third))
        x = points[..., 0]
        seen = (points[..., 2].amin(1) > 0) & (x.amax(1) > 0) & (x.amin(1) < width)
        counts = torch.where(seen, bottom - top, 0)
        ends = counts.cumsum(0)
        total = int(ends[-1]) if len(ends) else 0
        self.triangle, y = _expanded(counts, top, ends - counts, total)
        centre = y + 0.5
        sorted_points = torch.stack([first, second, third], 1)
        corners = sorted_points[self.triangle].unbind(1)
        long, short = _crossings(corners, centre)
        left, right = (_first_centre(edge, width) for edge in (torch.minimum(long, short), torch.maximum(long, short)))
        self.counts = right - left
        self.sample = (view[self.triangle] * height + y) * width + left
        self.near, self.step = self._depths(sorted_points, corners[0], centre, left)

    def _depths(self, points: Tensor, origin: Tensor, y: Tensor, left: Tensor) -> tuple[Tensor, Tensor]:
        """Return 1/z at each row's first sample, and its change from sample to sample; within that of the corners."""
        gradient = _gradient(points)[self.triangle]
        low, high = (bound[self.triangle] for bound in points[..., 2].aminmax(dim=1))
        last = (self.counts - 1).clamp_min(0)
        at_left = origin[:, 2] + (gradient[:, 1] * (y - origin[:, 1]) + gradient[:, 0] * (left + 0.5 - origin[:, 0]))
        begin, end = (value.clamp(low, high) for value in (at_left, at_left + gradient[:, 0] * last))
        return begin, (end - begin) / last.clamp_min(1)

    def fragments(self, make: Callable[..., tuple[Tensor, Tensor, Tensor]]) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Yield what `make` (_fragments) returns of all rows, a bounded number of fragments at a time."""
        ends = self.counts.cumsum(0)
        total = int(ends[-1]) if len(ends) else 0
        if not total:
            return
        bounds = torch.tensor([[0, 0], [len(ends), total]])
        if total > _FRAGMENTS:  # parts end with rows, at most one row beyond the bound
            limits = torch.arange(_FRAGMENTS, total + _FRAGMENTS, _FRAGMENTS, device=ends.device).clamp_max(total)
            last = torch.searchsorted(ends, limits) + 1
            bounds = torch.cat([bounds[:1], torch.stack([last, ends[last - 1]], 1).cpu()])
        begins = ends - self.counts
        for (first, before), (last, after) in pairwise(bounds.tolist()):
            counts = self.counts[first:last]
            row = torch.repeat_interleave(counts, output_size=after - before) + first
            yield make(row, before, begins, self.near, self.step, self.triangle, self.sample)


def _first_centre(edge: Tensor, limit: int) -> Tensor:
    """Return the number, 0..limit, of the first sample whose centre is not before an edge, int64."""
    return (edge - 0.5).ceil().clamp(0, limit).long()


def _sorted_by_y(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the corners [NT,3] of triangles [NT,3,3] from the uppermost to the lowest, the left one before the right.

    Triangles that coincide then have the same depths, whatever their order of corners: the first of them is seen.
    """

    def ordered(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
        lower = (one[:, 1] > other[:, 1]) | (one[:, 1] == other[:, 1]) & (one[:, 0] > other[:, 0])
        swap = lower[:, None]
        return torch.where(swap, other, one), torch.where(swap, one, other)

    first, second, third = points.unbind(1)
    first, second = ordered(first, second)
    second, third = ordered(second, third)
    first, second = ordered(first, second)
    return first, second, third


def _crossings(corners: tuple[Tensor, ...], y: Tensor) -> tuple[Tensor, Tensor]:
    """Return x where rows cross the longest edge and one of the others; triangles with this edge find the same x.

    Args:
        corners: From the uppermost to the lowest, [R,3] each.
    """
    first, second, third = corners
    upper = (y < second[:, 1])[:, None]
    edges = ((first, third), (torch.where(upper, first, second), torch.where(upper, second, third)))

    def crossing(above: Tensor, below: Tensor) -> Tensor:
        slope = (below[:, 0] - above[:, 0]) / (below[:, 1] - above[:, 1])
        return above[:, 0] + (y - above[:, 1]) * slope

    long, short = (crossing(above, below) for above, below in edges)
    return long, short


def _gradient(points: Tensor) -> Tensor:
    """Return the change of 1/z per sample to the right and down, [NT,2]; 0 for triangles without area."""
    (x1, y1, n1), (x2, y2, n2) = ((points[:, corner] - points[:, 0]).unbind(-1) for corner in (1, 2))
    area = x1 * y2 - x2 * y1
    flat = torch.stack([n1 * y2 - n2 * y1, x1 * n2 - x2 * n1], -1)
    return torch.where(area.abs()[:, None] > 1e-9, flat / area[:, None], 0)
