"""The light detection of MR360 (Rhee et al. 2017, Sections 3.2, 4 and 6.3) with OpenCV, one thread: a peer for mr360-bench.

Inverse tone map, upper half of the working map, 3x3 box blur, threshold at mu + 2 sigma, connected components, lights from the
excess over the threshold, nine spherical harmonics of the rest. Written to be as fast as OpenCV allows: everything is 8 bits for as
long as it can be, luma is OpenCV's own (0.299, 0.587, 0.114 where the paper rounds), whatever does not depend on the frame is a table
made once, lifted luminance is a table of the 8-bit luma (k Y, as the lift scales all channels alike), lifted colour is made only of
pixels above the threshold and, for the harmonics, of a map of half the size, and no picture is allocated twice. The size-dependent intensity, which the paper does not give, is mr360-server's own choice,
so that both can be compared.

Speaks lines on stdin and stdout. First it prints OpenCV's version. "size W" sets the working map's width, 600 before it is asked for;
"frame W H" is followed by W*H*3 bytes of sRGB and answered "ok"; "planes W H" is followed by W*H*3/2 bytes of planar 4:2:0, BT.709,
limited range; "run" estimates once and is answered with its milliseconds; "light" is answered with the light as JSON.
"""

import json
import sys
import time

import cv2
import numpy as np

MOST_LIGHTS = 64
KEPT_SHARE = 0.9
# R'G'B' of 8-bit Y'CbCr, BT.709, limited range, offsets in the last column.
RGB_FROM_YUV = np.array(
    [[255 / 219, 0, 1.5748 * 255 / 224], [255 / 219, -0.187324 * 255 / 224, -0.468124 * 255 / 224], [255 / 219, 1.8556 * 255 / 224, 0]]
)
RGB_FROM_YUV = np.hstack([RGB_FROM_YUV, -RGB_FROM_YUV @ [[16], [128], [128]]]).astype(np.float32)
# Iorns & Rhee 2015, Eq. 2, over the 256 values of luma; for codes, and times the luma itself.
FACTOR = (10 * (np.arange(256) / 255) ** 10 + 1.8).astype(np.float32) / 255
LIFTED_LUMA = (FACTOR * np.arange(256)).astype(np.float32)

cv2.setNumThreads(1)


def angles(width, height):
    """Longitudes of the columns, latitudes and pixel solid angles of the rows."""
    longitudes = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitudes = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    edges = np.sin((0.5 - np.arange(height + 1) / height) * np.pi)
    return longitudes, latitudes, (edges[:-1] - edges[1:]) * 2 * np.pi / width


def basis(width, height):
    """pixels x 9."""
    longitudes, latitudes, _ = angles(width, height)
    longitude, latitude = np.meshgrid(longitudes, latitudes)
    x, y, z = np.cos(latitude) * np.sin(longitude), np.sin(latitude), -np.cos(latitude) * np.cos(longitude)
    functions = [
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
    return np.stack(functions, -1).reshape(-1, 9).astype(np.float32)


class Map:
    """Tables and pictures of one size of working map: fresh memory for each frame costs more than the work."""

    def __init__(self, width):
        self.width, self.height, self.upper = width, width // 2, width // 4
        self.longitude, self.latitude, self.solid_angle = angles(self.width, self.height)
        self.basis = np.ascontiguousarray(basis(self.width, self.height)[: self.width * self.upper])
        half, low = (self.width // 2, self.height // 2), (self.width // 8, self.height // 8)
        self.low_size, self.half_size = low, half
        self.low_basis = np.ascontiguousarray((basis(*low) * np.repeat(angles(*low)[2], low[0])[:, None]).T.astype(np.float32))
        self.planes = [np.empty((self.height, self.width), np.uint8) for _ in range(3)]
        self.yuv, self.small = (np.empty((self.height, self.width, 3), np.uint8) for _ in range(2))
        self.luma = np.empty((self.upper, self.width), np.uint8)
        self.luminance, self.blurred = (np.empty((self.upper, self.width), np.float32) for _ in range(2))
        self.mask = np.empty((self.upper, self.width), np.uint8)
        self.labels = np.empty((self.upper, self.width), np.uint16)
        self.half = np.empty((half[1], half[0], 3), np.uint8)
        self.half_luma = np.empty((half[1], half[0]), np.uint8)
        self.factor = np.empty((half[1], half[0]), np.float32)
        self.factors = np.empty((half[1], half[0], 3), np.float32)
        self.radiance = np.empty((half[1], half[0], 3), np.float32)
        self.low = np.empty((low[1], low[0], 3), np.float32)

    def shrink(self, frame):
        """The frame at the working size as 8-bit R'G'B'."""
        size = (self.width, self.height)
        if not isinstance(frame, tuple):
            cv2.resize(frame, size, dst=self.small, interpolation=cv2.INTER_LINEAR)
            return
        for plane, to in zip(frame, self.planes):
            cv2.resize(plane, size, dst=to, interpolation=cv2.INTER_LINEAR)
        cv2.merge(self.planes, dst=self.yuv)
        cv2.transform(self.yuv, RGB_FROM_YUV, dst=self.small)

    def estimate(self, frame):
        """Coefficients and lights."""
        self.shrink(frame)
        cv2.cvtColor(self.small[: self.upper], cv2.COLOR_RGB2GRAY, dst=self.luma)
        cv2.LUT(self.luma, LIFTED_LUMA, dst=self.luminance)
        cv2.blur(self.luminance, (3, 3), dst=self.blurred, borderType=cv2.BORDER_REPLICATE)
        mean, deviation = cv2.meanStdDev(self.blurred)
        threshold = max(mean[0, 0] + 2 * deviation[0, 0], mean[0, 0] * 1.001)
        cv2.compare(self.blurred, threshold, cv2.CMP_GT, dst=self.mask)
        count, _ = cv2.connectedComponents(self.mask, labels=self.labels, connectivity=8, ltype=cv2.CV_16U)
        sh = self.harmonics()
        lights = self.take_out(count, threshold, sh) if count > 1 else []
        return sh, lights

    def harmonics(self):
        """9 x 3, of everything, lights included."""
        cv2.resize(self.small, self.half_size, dst=self.half, interpolation=cv2.INTER_AREA)
        cv2.cvtColor(self.half, cv2.COLOR_RGB2GRAY, dst=self.half_luma)
        cv2.LUT(self.half_luma, FACTOR, dst=self.factor)
        cv2.merge((self.factor, self.factor, self.factor), dst=self.factors)
        cv2.multiply(self.half, self.factors, dst=self.radiance, dtype=cv2.CV_32F)
        cv2.resize(self.radiance, self.low_size, dst=self.low, interpolation=cv2.INTER_AREA)
        return self.low_basis @ self.low.reshape(-1, 3)

    def take_out(self, count, threshold, sh):
        """Lights of the labelled regions; the excess of those that are kept leaves the harmonics."""
        places = cv2.findNonZero(self.mask).reshape(-1, 2)
        columns, rows = places[:, 0], places[:, 1]
        flat = rows * self.width + columns
        label = self.labels.ravel()[flat]
        brightness = self.luminance.ravel()[flat]
        colour = self.small.reshape(-1, 3)[flat] * FACTOR[self.luma.ravel()[flat]][:, None]
        solid_angle = self.solid_angle[rows]
        share = np.maximum(0, 1 - threshold / np.maximum(brightness, 1e-20)) * solid_angle
        strength = brightness * share

        def total(weights):
            return np.bincount(label, weights, count)[1:]

        power = total(strength)
        order = np.argsort(-power, kind="stable")
        order = order[power[order] > 0]
        held = np.cumsum(power[order])
        kept = order[: min(MOST_LIGHTS, int(np.searchsorted(held, KEPT_SHARE * held[-1]) + 1))] if len(order) else order
        # Eq. 5: the mean of angles, not of directions.
        safe = np.maximum(power, 1e-20)
        longitude = total(self.longitude[columns] * strength) / safe
        latitude = total(self.latitude[rows] * strength) / safe
        size = total(solid_angle)
        excess = colour * share[:, None].astype(np.float32)
        irradiance = np.stack([total(excess[:, channel]) for channel in range(3)], 1)
        taken = np.zeros(count, bool)
        taken[kept + 1] = True
        taken = taken[label]
        sh -= self.basis[flat[taken]].T @ excess[taken]
        boost = 1.5 - np.clip((size - 0.1) / 0.5, 0, 1)
        return [(longitude[i], latitude[i], irradiance[i] * boost[i], size[i]) for i in kept]


def described(sh, lights):
    def light(longitude, latitude, irradiance, size):
        across = np.cos(latitude)
        direction = [across * np.sin(longitude), np.sin(latitude), -across * np.cos(longitude)]
        return {"direction": [float(v) for v in direction], "irradiance": irradiance.tolist(), "solid_angle_sr": float(size)}

    return {"sh": sh.tolist(), "lights": [light(*each) for each in lights]}


def read(shape):
    return np.frombuffer(sys.stdin.buffer.read(int(np.prod(shape))), np.uint8).reshape(shape)


def main():
    def say(text):
        print(text, flush=True)

    say(f"OpenCV {cv2.__version__}")
    working, frame, result = Map(600), None, None
    while question := sys.stdin.buffer.readline().decode().split():
        if question[0] == "size":
            working = Map(int(question[1]))
            say("ok")
        elif question[0] == "frame":
            width, height = map(int, question[1:])
            frame = read((height, width, 3))
            say("ok")
        elif question[0] == "planes":
            width, height = map(int, question[1:])
            frame = (read((height, width)), *(read((height // 2, width // 2)) for _ in range(2)))
            say("ok")
        elif question[0] == "run":
            started = time.perf_counter()
            result = working.estimate(frame)
            say((time.perf_counter() - started) * 1e3)
        else:
            say(json.dumps(described(*result)))


if __name__ == "__main__":
    main()
