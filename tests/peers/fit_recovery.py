#!/usr/bin/env python3
"""Fits the regression of server/src/lighting/recovery/excess.rs and prints its constants as Rust.

    fit_recovery.py FOLDER [--held-out NAME,NAME,...] [--seed N]
    fit_recovery.py FOLDER --in-sample PERCENTILE,PERCENTILE,...

FOLDER holds panoramas with true radiance, 2:1, .npy or what OpenCV reads: .hdr, and .exr where it was built with OpenEXR. Those held out are only
measured. Needs numpy and opencv-python-headless.

With --in-sample the weights are fitted to each percentile alone and to all the panoramas that they are then measured on, with next to nothing to
keep them from it: no method may do so, and none with these features can do much better. Prints a line of JSON a panorama and percentile.

Each panorama is clipped at five percentiles of its luminance and made 8-bit sRGB; what the recovery knows of a frame is worked out as the server
does (cells.rs, blur.rs); the weights minimise ln(absolute + 0.08) + ln(scale-invariant error + 0.08) of the irradiance over 32 normals, and a
tenth of the squared error of the logarithm of hidden over shown luminance, by Adam. Panoramas that show one place, NAME~anything, share a weight.
"""
import argparse
import json
import os
import pathlib

os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
import cv2
import numpy as np

WIDTH, HEIGHT, SIDE = 512, 256, 4
COLUMNS, ROWS = WIDTH // SIDE, HEIGHT // SIDE
LUMA = np.array([0.2126, 0.7152, 0.0722])
CLIPPED = 0.92, 0.99
PERCENTILES = 93, 95, 97, 98, 99
UNITS, STEPS, RATE, DECAY, PIXELS, FLOOR = 3, 200, 0.03, 0.03, 0.1, 0.08
# Of fits to what they are measured on: steps, weights of small weights and of single places, starts of which the best is taken.
FREE = dict(steps=1000, decay=0.003, pixels=0.02)
STARTS = 3


def directions(width, height):
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    return np.stack([np.cos(latitude) * np.sin(longitude), np.sin(latitude), -np.cos(latitude) * np.cos(longitude)], -1)


def solid_angles(width, height):
    edges = np.sin((0.5 - np.arange(height + 1) / height) * np.pi)
    return np.repeat((edges[:-1] - edges[1:])[:, None] * 2 * np.pi / width, width, 1)


TEXELS, TEXEL_SR = directions(WIDTH, HEIGHT), solid_angles(WIDTH, HEIGHT)
CELLS, CELL_SR = directions(COLUMNS, ROWS), solid_angles(COLUMNS, ROWS)


class Normals:
    """Surfaces whose irradiance is compared."""

    def __init__(self, width, height):
        self.solid_angle = solid_angles(width, height).ravel()
        self.from_cells = np.maximum(directions(width, height).reshape(-1, 3) @ CELLS.reshape(-1, 3).T, 0)



def cells(values):
    return values.reshape(ROWS, SIDE, COLUMNS, SIDE, *values.shape[2:]).sum((1, 3))


def blur(field, reach):
    cosines = np.maximum(np.cos((0.5 - (np.arange(ROWS) + 0.5) / ROWS) * np.pi), 1e-3)
    for _ in range(2):
        rows = np.empty_like(field)
        for row, values in enumerate(field):
            half = int(round(reach / cosines[row]))
            if 2 * half + 1 >= COLUMNS:
                rows[row] = values.mean()
                continue
            sums = np.concatenate([[0], np.cumsum(np.concatenate([values[COLUMNS - half:], values, values[:half]]))])
            rows[row] = (sums[2 * half + 1:] - sums[:-2 * half - 1]) / (2 * half + 1)
        weight = CELL_SR[:, :1]
        sums = np.concatenate([np.zeros((1, COLUMNS)), np.cumsum(rows * weight, 0)])
        weights = np.concatenate([[0], np.cumsum(weight[:, 0])])
        first, last = np.maximum(np.arange(ROWS) - reach, 0), np.minimum(np.arange(ROWS) + reach + 1, ROWS)
        field = (sums[last] - sums[first]) / (weights[last] - weights[first])[:, None]
    return field


def clip(radiance, percentile):
    """The panorama with white at a percentile of its luminance, and as 8-bit sRGB shows it."""
    true = radiance / np.percentile(radiance @ LUMA, percentile)
    shown = np.clip(true, 0, 1)
    code = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    code = np.round(code * 255) / 255
    return true, np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def describe(shown):
    """Size, height, ground and surroundings of every cell, its clipped flux, and the colour of the rim."""
    rise = np.clip((shown - CLIPPED[0]) / (CLIPPED[1] - CLIPPED[0]), 0, 1)
    degree = rise * rise * (3 - 2 * rise)
    any_channel, all_channels, luminance = degree.max(-1), degree.min(-1), shown @ LUMA
    share = cells(TEXEL_SR * all_channels) / CELL_SR
    open_share = 1 - cells(TEXEL_SR * any_channel) / CELL_SR
    bright = cells(TEXEL_SR * luminance * (1 - any_channel)) / CELL_SR
    height = TEXELS[..., 1]
    level = abs(height) * TEXEL_SR
    sky, below = (luminance * level)[height > 0].sum(), height < -0.25
    ground = np.pi * (luminance * level)[below].sum() / level[below].sum()
    ground_ln = np.log(ground / max(sky, 1e-9) + 0.03)
    places = [blur(share, 3), CELLS[..., 1], np.full_like(share, ground_ln), np.log(blur(bright, 8) / (blur(open_share, 8) + 1e-3) + 0.02)]
    open_rgb = cells((TEXEL_SR * (1 - any_channel))[..., None] * shown)
    rim = (open_rgb * blur(share, 1)[..., None]).sum((0, 1)) + 1e-5
    tint = np.exp([np.clip(np.log(rim[0] / rim[1]), -0.7, 0.7), 0, 0.7 * np.clip(np.log(rim[2] / rim[1]), -0.7, 0.7)])
    return np.stack(places, -1).reshape(-1, 4), cells(TEXEL_SR * ((shown * degree) @ LUMA)).ravel(), tint / (tint @ LUMA)


def sample(radiance, percentile, normals):
    true, shown = clip(radiance, percentile)
    places, flux, tint = describe(shown)
    used = np.nonzero(flux > 1e-7)[0]
    hidden = cells(TEXEL_SR * ((true - shown) @ LUMA)).ravel()[used]
    energy = lambda radiance: normals.from_cells @ cells(TEXEL_SR[..., None] * radiance).reshape(-1, 3)
    return dict(
        places=places[used],
        flux=flux[used],
        hidden=hidden,
        normals=normals,
        to_normals=normals.from_cells[:, used],
        tint=tint,
        truth=energy(true),
        shown=energy(shown),
    )


def errors(estimate, truth, normals):
    """Absolute and scale-invariant error, and the gradient of the sum of their logarithms."""
    weight = normals.solid_angle[:, None]
    values = 3 * normals.solid_angle.sum()
    total = (weight * truth).sum()
    absolute = (weight * abs(estimate - truth)).sum() / total
    scale = (weight * estimate * truth).sum() / (weight * estimate * estimate).sum()
    rest = scale * estimate - truth
    squares, mean = (weight * rest * rest).sum() / values, total / values
    invariant = np.sqrt(squares) / mean
    gradient = weight * np.sign(estimate - truth) / total / (absolute + FLOOR)
    gradient = gradient + weight * rest * scale / values / (np.sqrt(squares) + 1e-9) / mean / (invariant + FLOOR)
    return absolute, invariant, gradient


def excess_ln(model, places):
    x = np.clip((places - model["mean"]) / model["deviation"], -3, 3)
    return np.minimum(x @ model["linear"] + model["offset"] + np.tanh(x @ model["inner"] + model["inner_offset"]) @ model["outer"], 6.0)


def fit(samples, weights, seed, steps=STEPS, decay=DECAY, pixels=PIXELS):
    """Weights, and the loss that they end with."""
    places = np.concatenate([s["places"] for s in samples])
    ends = np.cumsum([0] + [len(s["places"]) for s in samples])
    parts = [slice(a, b) for a, b in zip(ends, ends[1:])]
    flux = np.concatenate([s["flux"] for s in samples])
    target = np.log(np.clip(np.concatenate([s["hidden"] for s in samples]) / flux, 0.05, 400))
    share = np.concatenate([w * s["flux"] / s["flux"].sum() for s, w in zip(samples, weights)])
    mean, deviation = np.average(places, 0, share), np.sqrt(np.average((places - np.average(places, 0, share)) ** 2, 0, share))
    x = np.clip((places - mean) / deviation, -3, 3)
    random = np.random.default_rng(seed)
    state = [np.zeros(4), np.array([0.7]), random.normal(0, 0.25, (4, UNITS)), random.normal(0, 0.3, UNITS), random.normal(0, 0.1, UNITS)]
    first, second = [np.zeros_like(p) for p in state], [np.zeros_like(p) for p in state]
    for step in range(1, steps + 1):
        unit = np.tanh(x @ state[2] + state[3])
        ln = np.minimum(x @ state[0] + state[1] + unit @ state[4], 6.0)
        added, slope, loss = flux * np.exp(ln), np.zeros(len(ln)), 0.0
        for s, w, part in zip(samples, weights, parts):
            absolute, invariant, gradient = errors(s["shown"] + (s["to_normals"] @ added[part])[:, None] * s["tint"], s["truth"], s["normals"])
            loss += w * (np.log(absolute + FLOOR) + np.log(invariant + FLOOR))
            slope[part] = w * (s["to_normals"].T @ (gradient @ s["tint"])) * added[part]
        slope += pixels * share * 2 * np.clip(ln - target, -1, 1)
        inner = slope[:, None] * state[4] * (1 - unit * unit)
        gradients = [x.T @ slope + decay * state[0], np.array([slope.sum()]), x.T @ inner + decay * state[2], inner.sum(0), unit.T @ slope + decay * state[4]]
        rate = RATE * (1 if step <= 0.6 * steps else 0.3 if step <= 0.85 * steps else 0.1)
        for p, g, m, v in zip(state, gradients, first, second):
            m += 0.1 * (g - m)
            v += 0.01 * (g * g - v)
            p -= rate * (m / (1 - 0.9**step)) / (np.sqrt(v / (1 - 0.99**step)) + 1e-8)
    names = "linear", "offset", "inner", "inner_offset", "outer"
    return dict(zip(names, state), mean=mean, deviation=deviation), loss


def measure(model, s):
    """Absolute and scale-invariant error of a sample."""
    added = s["flux"] * np.exp(excess_ln(model, s["places"]))
    return errors(s["shown"] + (s["to_normals"] @ added)[:, None] * s["tint"], s["truth"], s["normals"])[:2]


def report(name, model, samples):
    rows = np.array([measure(model, s) for s in samples])
    print(f"// {name}: absolute {100 * np.median(rows[:, 0]):.1f} %, scale-invariant {100 * np.median(rows[:, 1]):.1f} %, medians of {len(rows)}")


def load(path):
    image = np.load(path) if path.suffix == ".npy" else cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.shape[1] != 2 * image.shape[0]:
        raise SystemExit(f"{path}: no panorama of 2:1 that is read here; give .npy, .hdr, or .exr where OpenCV has OpenEXR")
    image = image if path.suffix == ".npy" else image[..., 2::-1]
    image = cv2.resize(image.astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    return np.maximum(np.nan_to_num(image), 0).astype(float)


def in_sample(maps, percentile):
    """The best fit to all panoramas at one percentile, measured on them."""
    # Fitted over few normals, and measured over as many as the benches judge by.
    few, many = Normals(8, 4), Normals(32, 16)
    samples = [sample(radiance, percentile, few) for radiance in maps.values()]
    weights = np.full(len(samples), 1 / len(samples))
    fits = [fit(samples, weights, seed, **FREE) for seed in range(STARTS)]
    model, _ = min(fits, key=lambda fitted: fitted[1])
    for name, radiance in maps.items():
        absolute, invariant = measure(model, sample(radiance, percentile, many))
        print(json.dumps(dict(panorama=name, percentile=percentile, absolute=absolute, scale_invariant=invariant)), flush=True)


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("folder", type=pathlib.Path)
    arguments.add_argument("--held-out", default="", help="names without their endings, separated by commas")
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--in-sample", default="", help="percentiles, separated by commas")
    given = arguments.parse_args()
    held_out = set(filter(None, given.held_out.split(",")))
    maps = {path.stem: load(path) for path in sorted(given.folder.iterdir()) if path.suffix in (".npy", ".exr", ".hdr")}
    missing = held_out - maps.keys()
    if missing or len(maps) - len(held_out) < 2:
        raise SystemExit(f"{given.folder}: {'no ' + ', '.join(sorted(missing)) if missing else 'fewer than two panoramas to fit'}")
    if given.in_sample:
        for percentile in given.in_sample.split(","):
            in_sample(maps, int(percentile))
        return
    normals = Normals(8, 4)
    samples = {(name, p): sample(radiance, p, normals) for name, radiance in maps.items() for p in PERCENTILES}
    tuned = [key for key in samples if key[0] not in held_out]
    places = [name.split("~")[0] for name, _ in tuned]
    weights = np.array([(places.count(place) / len(PERCENTILES)) ** -0.5 for place in places])
    model, _ = fit([samples[key] for key in tuned], weights / weights.sum(), given.seed)
    for percentile in (95, 99):
        report(f"tuned, white at {percentile} %", model, [samples[key] for key in tuned if key[1] == percentile])
        if held_out:
            report(f"held out, white at {percentile} %", model, [samples[key] for key in samples if key[0] in held_out and key[1] == percentile])
    rust = lambda values: "[" + ", ".join(f"{v:.5f}" for v in values) + "]"
    print(f"const MEAN: [f32; 4] = {rust(model['mean'])};\nconst DEVIATION: [f32; 4] = {rust(model['deviation'])};")
    print(f"const LINEAR: [f32; 4] = {rust(model['linear'])};\nconst OFFSET: f32 = {model['offset'][0]:.5f};")
    for unit in range(UNITS):
        print(f"    ({rust(model['inner'][:, unit])}, {model['inner_offset'][unit]:.5f}, {model['outer'][unit]:.5f}),")


if __name__ == "__main__":
    main()
