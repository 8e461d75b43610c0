"""Robot arms: meshes where the description has them, and the licences that travel with them."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from importlib.resources import files

import numpy as np
import pytest

from warp_deform.robots import Robot, robot


@pytest.fixture(params=("ur5", "panda"))
def arm(request: pytest.FixtureRequest) -> Robot:
    return robot(request.param)


def test_meshes_fit_their_links(arm: Robot) -> None:
    links = arm.link_poses(arm.home_q)
    points = {}
    for link, pose, mesh in arm.meshes():
        vertices = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        assert 8 <= len(mesh.faces) <= 2000
        assert np.abs(vertices).max() < 0.5
        world = vertices @ links[link][0, :3, :3].T + links[link][0, :3, 3]
        points.setdefault(link, []).append(world)
    every = np.concatenate([np.concatenate(part) for part in points.values()])
    tip = links["tip"][0, :3, 3]
    # The arm stands on the table and reaches from the base to the tip, not below the table.
    assert -0.01 < every[:, 2].min() < 0.01 and 0.4 < every[:, 2].max() < 1.0
    assert np.linalg.norm(every - tip, axis=1).min() < 0.02
    # Each link's mesh overlaps the box of the one before: nothing floats.
    chain = list(points.values())
    for before, after in itertools.pairwise(chain):
        a, b = np.concatenate(before), np.concatenate(after)
        gap = np.maximum(a.min(0) - b.max(0), b.min(0) - a.max(0)).max()
        assert gap < 0.01


def test_meshes_are_where_the_urdf_has_them(arm: Robot) -> None:
    drawn = {(link, len(mesh.faces)) for link, _, mesh in arm.meshes()}
    for link in ET.fromstring(arm.urdf).findall("link"):
        for collision in link.findall("collision"):
            mesh = collision.find("geometry/mesh")
            if mesh is not None:
                assert collision.find("origin") is None
                assert any(name == link.get("name") for name, _ in drawn)


def test_licences_travel_with_the_assets() -> None:
    assets = files("warp_deform.robots").joinpath("assets")
    for name, licence in (("ur5", "Redistribution and use"), ("panda", "Apache License")):
        notice = assets.joinpath(name, "NOTICE").read_text()
        assert licence in notice and "example-robot-data 4.3.0" in notice
    assert "TERMS AND CONDITIONS" in assets.joinpath("panda", "LICENSE").read_text()
