"""benchmarks/gaussian_parts.py: a scene all round, of which a camera sees a fifth, and the rows of one process."""

from benchmarks import gaussian_parts
from lightfield_gs import gsplat


def test_a_camera_sees_a_fifth_of_the_scene_and_both_ways_are_timed():
    fields = gaussian_parts.part(2000, (64, 48), 0)
    for sector in range(gaussian_parts.SECTORS):
        step = gaussian_parts.step_of(gsplat, fields, sector, (64, 48), {"sparse_grad": True})
        assert 0.15 < len(step()["gaussian_ids"]) / 2000 < 0.3
    found = gaussian_parts.rows(500, (32, 24), "cpu", 1)
    assert [row[:2] for row in found] == [("dense", 1), ("sparse", 1)] and all(row[2] > 0 for row in found)
