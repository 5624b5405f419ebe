"""The light detection of MR360 (Rhee et al. 2017, Sections 3.2, 4 and 6.3) with OpenCV, one thread: a peer for mr360-bench.

Inverse tone map, 600x150 upper half, 3x3 box blur, threshold at mu + 2 sigma, connected components, lights from the excess
over the threshold, nine spherical harmonics of the rest. Whatever does not depend on the frame is a table made once.
The size-dependent intensity, which the paper does not give, is mr360-server's own choice, so that both can be compared.

Speaks lines on stdin and stdout. First it prints OpenCV's version. "frame W H" is followed by W*H*3 bytes of sRGB and answered
"ok"; "run" estimates once and is answered with its milliseconds; "light" is answered with the light as JSON.
"""

import json
import sys
import time

import cv2
import numpy as np

WIDTH, HEIGHT, UPPER = 600, 300, 150
SH_WIDTH, SH_HEIGHT = 60, 30
MOST_LIGHTS = 64
KEPT_SHARE = 0.9
LUMA = np.array([[0.3, 0.59, 0.11]], np.float32)

cv2.setNumThreads(1)


def angles(width, height):
    """Longitudes of the columns, latitudes and pixel solid angles of the rows."""
    longitudes = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitudes = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    edges = np.sin((0.5 - np.arange(height + 1) / height) * np.pi)
    return longitudes, latitudes, (edges[:-1] - edges[1:]) * 2 * np.pi / width


def sh_table():
    """9 x pixels: basis times solid angle."""
    longitudes, latitudes, solid_angles = angles(SH_WIDTH, SH_HEIGHT)
    longitude, latitude = np.meshgrid(longitudes, latitudes)
    x, y, z = np.cos(latitude) * np.sin(longitude), np.sin(latitude), -np.cos(latitude) * np.cos(longitude)
    basis = [
        np.full_like(x, 0.2820948),
        0.4886025 * y,
        0.4886025 * z,
        0.4886025 * x,
        1.0925484 * x * y,
        1.0925484 * y * z,
        0.31539157 * (3 * z * z - 1),
        1.0925484 * x * z,
        0.5462742 * (x * x - y * y),
    ]
    return (np.stack(basis) * solid_angles[:, None]).reshape(9, -1).astype(np.float32)


# Iorns & Rhee 2015, Eq. 2, over the 256 values of luma.
FACTOR = (10 * (np.arange(256) / 255) ** 10 + 1.8).astype(np.float32) / 255
LONGITUDE, LATITUDE, SOLID_ANGLE = angles(WIDTH, HEIGHT)
SH = sh_table()


class Buffers:
    """Pictures that every frame is worked out in: fresh memory for each costs more than the work."""

    def __init__(self):
        self.small = np.empty((HEIGHT, WIDTH, 3), np.uint8)
        self.luma = np.empty((HEIGHT, WIDTH), np.uint8)
        self.factor = np.empty((HEIGHT, WIDTH), np.float32)
        self.factors = np.empty((HEIGHT, WIDTH, 3), np.float32)
        self.radiance = np.empty((HEIGHT, WIDTH, 3), np.float32)
        self.luminance, self.blurred = (np.empty((UPPER, WIDTH), np.float32) for _ in range(2))
        self.mask = np.empty((UPPER, WIDTH), np.uint8)
        self.labels = np.empty((UPPER, WIDTH), np.uint16)


def estimate(frame, to):
    cv2.resize(frame, (WIDTH, HEIGHT), dst=to.small, interpolation=cv2.INTER_LINEAR)
    cv2.transform(to.small, LUMA, dst=to.luma)
    cv2.LUT(to.luma, FACTOR, dst=to.factor)
    cv2.merge((to.factor, to.factor, to.factor), dst=to.factors)
    cv2.multiply(to.small, to.factors, dst=to.radiance, dtype=cv2.CV_32F)
    cv2.transform(to.radiance[:UPPER], LUMA, dst=to.luminance)
    cv2.blur(to.luminance, (3, 3), dst=to.blurred, borderType=cv2.BORDER_REPLICATE)
    mean, deviation = cv2.meanStdDev(to.blurred)
    threshold = max(mean[0, 0] + 2 * deviation[0, 0], mean[0, 0] * 1.001)
    cv2.compare(to.blurred, threshold, cv2.CMP_GT, dst=to.mask)
    count, _ = cv2.connectedComponents(to.mask, labels=to.labels, connectivity=8, ltype=cv2.CV_16U)
    lights = take_out(to.radiance, to.luminance, to.mask, to.labels, count, threshold) if count > 1 else []
    low = cv2.resize(to.radiance, (SH_WIDTH, SH_HEIGHT), interpolation=cv2.INTER_AREA).reshape(-1, 3)
    return SH @ low, lights


def take_out(radiance, luminance, mask, labels, count, threshold):
    """Lights of the labelled regions; the excess of those that are kept leaves the radiance."""
    places = cv2.findNonZero(mask).reshape(-1, 2)
    columns, rows = places[:, 0], places[:, 1]
    flat = rows * WIDTH + columns
    label = labels.ravel()[flat]
    brightness = luminance.ravel()[flat]
    pixels = radiance.reshape(-1, 3)
    colour = pixels[flat]
    share = np.maximum(0, 1 - threshold / np.maximum(brightness, 1e-20))
    solid_angle = SOLID_ANGLE[rows]
    strength = brightness * share * solid_angle

    def total(weights):
        return np.bincount(label, weights, count)[1:]

    power = total(strength)
    order = np.argsort(-power, kind="stable")
    order = order[power[order] > 0]
    held = np.cumsum(power[order])
    kept = order[: min(MOST_LIGHTS, int(np.searchsorted(held, KEPT_SHARE * held[-1]) + 1))] if len(order) else order
    # Eq. 5: the mean of angles, not of directions.
    safe = np.maximum(power, 1e-20)
    longitude = total(LONGITUDE[columns] * strength) / safe
    latitude = total(LATITUDE[rows] * strength) / safe
    size = total(solid_angle)
    irradiance = np.stack([total(colour[:, c] * share * solid_angle) for c in range(3)], 1)
    taken = np.isin(label, kept + 1)
    pixels[flat[taken]] = colour[taken] * (1 - share[taken])[:, None].astype(np.float32)
    boost = 1.5 - np.clip((size - 0.1) / 0.5, 0, 1)
    return [(longitude[i], latitude[i], irradiance[i] * boost[i], size[i]) for i in kept]


def described(sh, lights):
    def light(longitude, latitude, irradiance, size):
        across = np.cos(latitude)
        direction = [across * np.sin(longitude), np.sin(latitude), -across * np.cos(longitude)]
        return {"direction": [float(v) for v in direction], "irradiance": irradiance.tolist(), "solid_angle_sr": float(size)}

    return {"sh": sh.tolist(), "lights": [light(*each) for each in lights]}


def main():
    def say(text):
        print(text, flush=True)

    say(f"OpenCV {cv2.__version__}")
    buffers, frame, result = Buffers(), None, None
    while question := sys.stdin.buffer.readline().decode().split():
        if question[0] == "frame":
            width, height = map(int, question[1:])
            frame = np.frombuffer(sys.stdin.buffer.read(width * height * 3), np.uint8).reshape(height, width, 3)
            say("ok")
        elif question[0] == "run":
            started = time.perf_counter()
            result = estimate(frame, buffers)
            say((time.perf_counter() - started) * 1e3)
        else:
            say(json.dumps(described(*result)))


main()
