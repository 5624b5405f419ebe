#!/usr/bin/env python3
"""Grey cards in a path-traced panorama, and the same place without them, for the test `grey_card`.

    pip install mitsuba==3.9.1 numpy
    DRJIT_LIBLLVM_PATH=PATH_OF_LIBLLVM python mitsuba_grey_card.py --out tests/references/grey-card

A sky of closed form with a sun lights a plain of even albedo and two houses. `without.exr` is the panorama from the camera's place; `with.png` shows the
cards of SCENE.toml in it, in sRGB. `cards.json` holds what the camera sees of each card's middle (PART of its sides), linear, and where that is: its centre
and half of its sides. The cards are of the viewer's own material, as `mitsuba_truth.py` has it, so that the light is compared and not the reflectance.
"""

import argparse
import json
import tomllib
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_truth import direction, environment, encode, material, placement, rgb, write_png

COLUMNS, ROWS, SAMPLES, RUNS = 384, 192, 64, 8
CARD_SAMPLES = 1 << 18
PART = 0.7
SUN_ELEVATION_DEG, SUN_AZIMUTH_DEG, SUN_HALF_ANGLE_DEG = 48.0, 150.0, 1.5
SUN_IRRADIANCE = np.array([2.2, 2.0, 1.7])
GROUND_ALBEDO, HOUSE_ALBEDO = [0.30, 0.27, 0.22], [0.45, 0.40, 0.36]
# Middle, half of the sides, and turn about y of each, metres and degrees.
HOUSES = [([-11, 1.4, -6], [2.5, 3, 4], 20), ([9, 0.9, 9], [4, 2.5, 2], -35)]


def sky(rows=512, columns=1024):
    """Bluer and darker upwards, and a disc of a sun."""
    longitude = ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * np.pi
    latitude = (0.5 - (np.arange(rows) + 0.5) / rows) * np.pi
    towards = direction(longitude[None, :], latitude[:, None])
    up = np.clip(towards[..., 1:2], 0, 1)
    radiance = np.array([0.42, 0.50, 0.62]) * (1 - up) + np.array([0.12, 0.22, 0.45]) * up
    sun = direction(np.radians(SUN_AZIMUTH_DEG), np.radians(SUN_ELEVATION_DEG))
    half = np.radians(SUN_HALF_ANGLE_DEG)
    inside = (towards @ sun > np.cos(half))[..., None]
    area = (np.cos(latitude)[:, None, None] * inside).sum() * (np.pi / rows) * (2 * np.pi / columns)
    return radiance + inside * SUN_IRRADIANCE / area


def place(ground_y):
    base = {"type": "scene", "light": environment(sky())}
    flat = mi.ScalarTransform4f().translate([0, ground_y, 0]).rotate([1, 0, 0], -90).scale(2000)
    base["ground"] = {"type": "rectangle", "to_world": flat, "bsdf": {"type": "diffuse", "reflectance": rgb(GROUND_ALBEDO)}}
    for at, (middle, half, turn) in enumerate(HOUSES):
        stand = mi.ScalarTransform4f().translate(middle).rotate([0, 1, 0], turn).scale(half)
        base[f"house{at}"] = {"type": "cube", "to_world": stand, "bsdf": {"type": "diffuse", "reflectance": rgb(HOUSE_ALBEDO)}}
    return base


def card(item):
    given = item["material"]
    bsdf = material(rgb(given["base_color"]), given["roughness"], given["metallic"])
    # Mitsuba's cube is two units wide.
    return {"type": "cube", "to_world": placement(item).scale(0.5), "bsdf": bsdf}


def traced(scene, towards, seed):
    """Radiance that arrives at the origin from these directions, one sample each."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, dr.width(towards))
    ray = mi.RayDifferential3f(mi.Point3f(0), towards)
    radiance, _, _ = mi.load_dict({"type": "path", "max_depth": 10}).sample(scene, sampler, ray)
    return np.array(radiance)


def panorama(scene):
    total = np.zeros((ROWS, COLUMNS, 3))
    for seed in range(RUNS):
        at = dr.arange(mi.UInt32, COLUMNS * ROWS * SAMPLES)
        jitter = mi.load_dict({"type": "independent"})
        jitter.seed(1000 + seed, dr.width(at))
        pixel, within = at // SAMPLES, jitter.next_2d()
        longitude = ((mi.Float(pixel % COLUMNS) + within.x) / COLUMNS - 0.5) * 2 * dr.pi
        latitude = (0.5 - (mi.Float(pixel // COLUMNS) + within.y) / ROWS) * dr.pi
        towards = mi.Vector3f(dr.cos(latitude) * dr.sin(longitude), dr.sin(latitude), -dr.cos(latitude) * dr.cos(longitude))
        total += traced(scene, towards, seed).reshape(3, ROWS, COLUMNS, SAMPLES).mean(3).transpose(1, 2, 0)
    return total / RUNS


def seen(scene, item):
    """What the camera sees of a card's middle, and where that is."""
    to_world = np.array(placement(item).matrix)
    across, up, front = (to_world[:3, axis] / 2 for axis in range(3))
    middle = to_world[:3, 3] + front
    points = np.random.default_rng(1).uniform(-PART, PART, (CARD_SAMPLES, 2))
    points = middle + points[:, :1] * across + points[:, 1:] * up
    towards = points / np.linalg.norm(points, axis=1, keepdims=True)
    radiance = traced(scene, mi.Vector3f(*(mi.Float(np.ascontiguousarray(towards[:, axis], np.float32)) for axis in range(3))), 7)
    noise = radiance.std(1) / np.sqrt(CARD_SAMPLES)
    corners = {"middle": middle.tolist(), "across": (PART * across).tolist(), "up": (PART * up).tolist()}
    return {"radiance": radiance.mean(1).tolist(), "standard_error": noise.tolist(), **corners}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder that holds SCENE.toml")
    out = parser.parse_args().out
    scene_file = tomllib.loads((out / "SCENE.toml").read_text())
    base = place(scene_file["ground_y"])
    cards = {f"card{at}": card(item) for at, item in enumerate(scene_file["object"])}
    empty, full = mi.load_dict(base), mi.load_dict(base | cards)
    report = [seen(full, item) for item in scene_file["object"]]
    (out / "cards.json").write_text(json.dumps({"mitsuba": mi.__version__, "cards": report}, indent=1) + "\n")
    without = mi.Bitmap(np.ascontiguousarray(panorama(empty), np.float32))
    without.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float16, srgb_gamma=False).write(str(out / "without.exr"))
    write_png(out / "with.png", encode(panorama(full)))
    print(json.dumps(report, indent=1))
