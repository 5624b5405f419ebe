#!/usr/bin/env python3
"""Path-traced truth for `mr360-bench render`: objects on a ground that looks, with nothing on it, exactly as the panorama does.

    pip install mitsuba==3.9.1 numpy
    DRJIT_LIBLLVM_PATH=PATH_OF_LIBLLVM \\
        python mitsuba_truth.py truth   --panoramas target/media/hdr --scene tests/references/truth/SCENE.toml --out tests/references/truth
        python mitsuba_truth.py shadows --scenes tests/references/shadows

Without DRJIT_LIBLLVM_PATH the LLVM library that the system has is used; 17 or newer, as 14 to 16 abort.

The ground is a plane. Its albedo at a point is π times the radiance that the panorama shows there, seen from the camera, over the irradiance of
level, unoccluded ground under the panorama. Where that exceeds ALBEDO_MOST the rest of the radiance is emitted, so that the ground looks right
there too; `truth.json` states the share of the visible ground's radiance that is. The panorama's lower half lies behind the ground and lights nothing.

Materials are metallic-roughness as glTF defines it, with energy kept: GGX scaled for multiple scattering (Turquin 2019, Eq. 16) over a
Lambertian base that gets what is not reflected. A roughness of 0 is a perfect mirror. Pixels are box filtered, colours clamped to [0, 1] and
sRGB encoded.

Every picture is the mean of RUNS renderings with fixed seeds. Where the camera sees nothing but ground, it is what the panorama shows plus the
difference between renderings with and without objects, of the same seeds: without bias, and noise is left only where objects change something.
Runs in which a pixel is far above its median (light focused by a mirror, found by chance) are left out of that pixel's mean; `truth.json`
states by how much that dims the picture. Conventions are checked with spots of light first.

`shadows` renders the visibility of distant discs on white ground: of each pixel the share of their light that arrives, and as alpha whether
nothing but ground is seen through it.
"""

import argparse
import json
import tomllib
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from truth_models import Gltf

mi.set_variant("llvm_ad_rgb")

# The eight of the panoramas that show level ground in front of the camera and whose ground could be lit by their upper half.
PANORAMAS = ["bridge", "city", "esplanade", "hall", "sky", "sunset", "venice", "warehouse"]
SIZE, FOV_Y_DEG, PITCH_DEG = (384, 216), 45.0, -14.0
# Names of the objects, in the order of SCENE.toml.
REGIONS = ["mirror", "metal", "diffuse", "fox", "bunny"]
ALBEDO_MOST = 0.95
RUNS, SAMPLES = 16, 64
# A run is left out of a pixel where it exceeds the median by this many median deviations, and by 2 % of white.
OUTLIER = (8.0, 0.02)
GROUND_CELL_DEG, GROUND_END_DEG = 1.0, 0.25
SHADOW_VIEW = ((320, 180), 45.0, -25.0)
LIGHT_COUNTS, DISTANCE_M = [1, 2, 4], 1000.0
# One row a light: elevation and azimuth from -z towards x, degrees, and solid angle, sr: a sun, a lamp, a window, a bright cloud.
LIGHTS = [(50, -60, 6.8e-5), (40, 75, 1e-3), (65, 160, 5e-3), (35, -140, 2e-2)]


def direction(longitude, latitude):
    """Equirect longitude and latitude to a direction; longitude 0 is -z and grows towards x."""
    return np.stack([np.cos(latitude) * np.sin(longitude), np.sin(latitude) + 0 * longitude, -np.cos(latitude) * np.cos(longitude)], -1)


def table_of_albedo(alpha, cosines=64, samples=512):
    """Scale A and bias B of F0 in the light that single-scattering GGX reflects, over the cosine of the angle of incidence."""
    i = np.arange(samples)
    u, v = np.meshgrid((i + 0.5) / samples, (np.arange(64) + 0.5) / 64, indexing="ij")
    tan2 = alpha**2 * u / (1 - u)
    cos_h = 1 / np.sqrt(1 + tan2)
    sin_h = np.sqrt(1 - cos_h**2)
    h = np.stack([sin_h * np.cos(2 * np.pi * v), sin_h * np.sin(2 * np.pi * v), cos_h], -1)

    def g1(c):
        return 2 * c / (c + np.sqrt(alpha**2 + (1 - alpha**2) * c**2))

    rows = []
    for cosine in np.maximum(np.linspace(0, 1, cosines), 1e-3):
        view = np.array([np.sqrt(1 - cosine**2), 0, cosine])
        v_dot_h = np.maximum(h @ view, 0)
        n_dot_l = 2 * v_dot_h * h[..., 2] - cosine
        weight = np.where(n_dot_l > 0, g1(np.maximum(n_dot_l, 1e-6)) * g1(cosine) * v_dot_h / (cosine * h[..., 2]), 0)
        schlick = (1 - v_dot_h) ** 5
        rows.append(((weight * (1 - schlick)).mean(), (weight * schlick).mean()))
    return np.array(rows).T


class MetallicRoughness(mi.BSDF):
    """See the top of the file."""

    def __init__(self, props):
        mi.BSDF.__init__(self, props)
        self.base = props.get_texture("base")
        self.metallic = float(props["metallic"])
        self.alpha = float(props["roughness"]) ** 2
        a, b = table_of_albedo(self.alpha)
        self.scale, self.bias, self.steps = mi.Float(a), mi.Float(b), len(a) - 1
        glossy = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        diffuse = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.SpatiallyVarying
        self.m_components = [glossy, diffuse]
        self.m_flags = glossy | diffuse

    def looked_up(self, table, cosine):
        at = dr.clip(cosine, 0, 1) * self.steps
        low = dr.minimum(mi.UInt32(at), self.steps - 1)
        share = at - mi.Float(low)
        return dr.lerp(dr.gather(mi.Float, table, low), dr.gather(mi.Float, table, low + 1), share)

    def colours(self, si, cos_i, active):
        """F0, what multiple scattering scales the highlight by, and the base's reflectance."""
        base = self.base.eval(si, active)
        f0 = dr.lerp(mi.Color3f(0.04), base, self.metallic)
        a, b = self.looked_up(self.scale, cos_i), self.looked_up(self.bias, cos_i)
        boost = 1 + f0 * (1 - a - b) / (a + b)
        return f0, boost, base * (1 - self.metallic) * dr.maximum(1 - (f0 * a + b) * boost, 0)

    def eval(self, ctx, si, wo, active=True):
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        active = mi.Bool(active) & (cos_i > 0) & (cos_o > 0)
        f0, boost, diffuse = self.colours(si, cos_i, active)
        distribution = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha)
        h = dr.normalize(si.wi + wo)
        fresnel = f0 + (1 - f0) * (1 - dr.maximum(dr.dot(si.wi, h), 0)) ** 5
        specular = fresnel * boost * distribution.eval(h) * distribution.G(si.wi, wo, h) / (4 * cos_i)
        return dr.select(active, specular + diffuse * dr.inv_pi * cos_o, 0)

    def pdf(self, ctx, si, wo, active=True):
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        active = mi.Bool(active) & (cos_i > 0) & (cos_o > 0)
        distribution = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha)
        h = dr.normalize(si.wi + wo)
        specular = distribution.pdf(si.wi, h) / (4 * dr.dot(wo, h))
        share = self.share()
        return dr.select(active, share * specular + (1 - share) * dr.inv_pi * cos_o, 0)

    def eval_pdf(self, ctx, si, wo, active=True):
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def share(self):
        """Of samples that follow the highlight."""
        return 0.9 if self.metallic > 0.5 else 0.4

    def sample(self, ctx, si, sample1, sample2, active=True):
        distribution = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha)
        h, _ = distribution.sample(si.wi, sample2)
        wo = dr.select(sample1 < self.share(), mi.reflect(si.wi, h), mi.warp.square_to_cosine_hemisphere(sample2))
        sampled = mi.BSDFSample3f()
        sampled.wo, sampled.eta, sampled.sampled_component = wo, 1.0, mi.UInt32(0)
        sampled.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        sampled.pdf = self.pdf(ctx, si, wo, active)
        weight = self.eval(ctx, si, wo, active) / sampled.pdf
        return sampled, dr.select(sampled.pdf > 0, weight, 0)

    def to_string(self):
        return f"MetallicRoughness[{self.alpha=}, {self.metallic=}]"


mi.register_bsdf("metallic_roughness", MetallicRoughness)


def load_panorama(path):
    """Radiance as (rows, columns, 3); what compression made negative or not a number is 0."""
    bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    return np.clip(np.nan_to_num(np.array(bitmap)), 0, 65504)


def environment(radiance):
    # Mitsuba takes the first and the last row to lie at the poles and not half a row off: between every two rows their mean is put in, and
    # the outermost ones twice.
    rows, columns, _ = radiance.shape
    spread = np.zeros((2 * rows + 1, columns, 3))
    spread[1::2] = radiance
    spread[2:-1:2] = (radiance[1:] + radiance[:-1]) / 2
    spread[0], spread[-1] = radiance[0], radiance[-1]
    radiance = spread
    # Its longitude 0 is +z; turned so that the centre is -z.
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], ENVIRONMENT_TURN_DEG)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(radiance, np.float32)), "to_world": turned}


ENVIRONMENT_TURN_DEG = 180.0


def ground_irradiance(radiance):
    """Of level, unoccluded ground under the panorama."""
    rows, columns, _ = radiance.shape
    latitude = (0.5 - (np.arange(rows) + 0.5) / rows) * np.pi
    weight = np.cos(latitude) * np.maximum(np.sin(latitude), 0) * (np.pi / rows) * (2 * np.pi / columns)
    return (radiance * weight[:, None, None]).sum((0, 1))


def mesh(name, positions, indices, normals=None, uvs=None, props=None):
    made = mi.Mesh(name, len(positions), len(indices), props or mi.Properties(), normals is not None, uvs is not None)
    values = mi.traverse(made)
    values["vertex_positions"] = mi.Float(np.ascontiguousarray(positions, np.float32).ravel())
    values["faces"] = mi.UInt32(np.ascontiguousarray(indices, np.uint32).ravel())
    if normals is not None:
        values["vertex_normals"] = mi.Float(np.ascontiguousarray(normals, np.float32).ravel())
    if uvs is not None:
        values["vertex_texcoords"] = mi.Float(np.ascontiguousarray(uvs, np.float32).ravel())
    values.update()
    return made


def with_bsdf(bsdf, emitter=None):
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(bsdf)
    if emitter:
        props["mesh_emitter"] = mi.load_dict(emitter)
    return props


def texture(values):
    bitmap = mi.Bitmap(np.ascontiguousarray(values, np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "repeat"}


def ground(ground_y, albedo, emitted=None):
    """A fan around the point beneath the camera, whose texture coordinates are the panorama's as seen from there."""
    longitudes = np.radians(np.linspace(-180, 180, int(360 / GROUND_CELL_DEG) + 1))
    depressions = np.radians(np.append(np.linspace(90 - 1e-3, 2, int(88 / GROUND_CELL_DEG) + 1), [1.5, 1, 0.75, 0.5, 0.35, GROUND_END_DEG]))
    longitude, depression = np.meshgrid(longitudes, depressions)
    distance = -ground_y / np.tan(depression)
    positions = np.stack([distance * np.sin(longitude), np.full_like(longitude, ground_y), -distance * np.cos(longitude)], -1)
    uvs = np.stack([longitude / (2 * np.pi) + 0.5, 0.5 + depression / np.pi], -1)
    columns = len(longitudes)
    at = (np.arange(len(depressions) - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    triangles = np.concatenate([np.stack([at, at + 1, at + columns], -1), np.stack([at + 1, at + columns + 1, at + columns], -1)])
    normals = np.broadcast_to([0.0, 1.0, 0.0], positions.reshape(-1, 3).shape)
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(albedo)}}
    emitter = {"type": "area", "radiance": texture(emitted), "sampling_weight": 0.05} if emitted is not None and emitted.max() > 0 else None
    return mesh("ground", positions.reshape(-1, 3), triangles, normals, uvs.reshape(-1, 2), with_bsdf(bsdf, emitter))


def material(base, roughness, metallic):
    if roughness == 0 and metallic == 1:
        return {"type": "conductor", "material": "none", "specular_reflectance": base}
    return {"type": "metallic_roughness", "base": base, "roughness": roughness, "metallic": metallic}


def rgb(values):
    return {"type": "rgb", "value": [float(x) for x in values]}


def placement(item):
    """An object's transform: rotations about y first, then x, then z."""
    x, y, z = item.get("rotation_deg", [0, 0, 0])
    scale = item.get("scale", 1.0)
    move = mi.ScalarTransform4f().translate(item["position"])
    return move.rotate([0, 1, 0], y).rotate([1, 0, 0], x).rotate([0, 0, 1], z).scale(scale)


def cylinder(to_world, around=96):
    """One metre across and high before it is placed."""
    angles = np.radians(np.linspace(0, 360, around + 1))[:-1]
    ring = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1) * 0.5
    at = np.arange(around)
    following, upper, middle = (at + 1) % around, at + around, 0 * at + 2 * around
    above = following + around
    positions = np.concatenate([ring - [0, 0.5, 0], ring + [0, 0.5, 0], [[0, -0.5, 0], [0, 0.5, 0]]])
    triangles = [(at, following, upper), (following, above, upper), (following, at, middle), (upper, above, middle + 1)]
    positions = np.c_[positions, np.ones(len(positions))] @ np.array(to_world.matrix).T
    indices = np.concatenate([np.stack(corners, -1) for corners in triangles])
    return mesh("cylinder", positions[:, :3], indices, props=with_bsdf({"type": "diffuse"}))


def load_object(item, folder):
    """One [[object]] of a SCENE.toml."""
    to_world = placement(item)
    if item.get("shape") == "sphere":
        given = item["material"]
        bsdf = material(rgb(given["base_color"]), given["roughness"], given["metallic"])
        return {"type": "sphere", "radius": 0.5, "to_world": to_world, "bsdf": bsdf}
    if item.get("shape") == "cylinder":
        return cylinder(to_world)
    model = Gltf(folder / item["model"])
    primitive = model.json["meshes"][0]["primitives"][0]
    attributes = {name: model.accessor(at) for name, at in primitive["attributes"].items()}
    indices = model.accessor(primitive["indices"]).reshape(-1, 3)
    given = model.json["materials"][0]["pbrMetallicRoughness"]
    uvs, base = None, rgb(given.get("baseColorFactor", [1, 1, 1])[:3])
    if "TEXCOORD_0" in attributes:
        uvs = attributes["TEXCOORD_0"]
        stream = mi.MemoryStream()
        stream.write(model.image(0))
        stream.seek(0)
        base = {"type": "bitmap", "bitmap": mi.Bitmap(stream).convert(mi.Bitmap.PixelFormat.RGB)}
    matrix = np.array(to_world.matrix)
    positions = np.c_[attributes["POSITION"], np.ones(len(attributes["POSITION"]))] @ matrix.T
    normals = attributes["NORMAL"] @ np.linalg.inv(matrix[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    bsdf = material(base, given.get("roughnessFactor", 1.0), given.get("metallicFactor", 1.0))
    return mesh(item["model"], positions[:, :3], indices, normals, uvs, with_bsdf(bsdf))


def camera(size=SIZE, fov_y_deg=FOV_Y_DEG, pitch_deg=PITCH_DEG):
    pitch = np.radians(pitch_deg)
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, float(np.sin(pitch)), -float(np.cos(pitch))], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}, "pixel_format": "rgb", "component_format": "float32"}
    return {"type": "perspective", "fov": fov_y_deg, "fov_axis": "y", "near_clip": 0.05, "to_world": to_world, "film": film}


def render(scene):
    """The runs of a scene."""
    return np.array([np.array(mi.render(scene, spp=SAMPLES, seed=seed)) for seed in range(RUNS)])


def robust_mean(pictures):
    """Mean of the runs without outliers."""
    middle = np.median(pictures, 0)
    spread = np.median(np.abs(pictures - middle), 0)
    kept = np.all(pictures <= middle + np.maximum(OUTLIER[0] * spread, OUTLIER[1]), -1, keepdims=True)
    return (pictures * kept).sum(0) / np.maximum(kept.sum(0), 1)


def seen(radiance, samples=4, size=SIZE, fov_y_deg=FOV_Y_DEG, pitch_deg=PITCH_DEG):
    """The panorama through the camera, each pixel the mean of samples², and the mean upwards component of their rays."""
    columns, rows = size[0] * samples, size[1] * samples
    tan, pitch = np.tan(np.radians(fov_y_deg / 2)), np.radians(pitch_deg)
    x, y = np.meshgrid(((np.arange(columns) + 0.5) / columns * 2 - 1) * tan * size[0] / size[1], (1 - (np.arange(rows) + 0.5) / rows * 2) * tan)
    y, z = y * np.cos(pitch) + np.sin(pitch), y * np.sin(pitch) - np.cos(pitch)
    length = np.sqrt(x * x + y * y + z * z)
    u, v = np.arctan2(x, -z) / (2 * np.pi) + 0.5, 0.5 - np.arcsin(y / length) / np.pi
    shown = bilinear(radiance, u, v)
    folded = (size[1], samples, size[0], samples)
    return shown.reshape(*folded, 3).mean((1, 3)), (y / length).reshape(folded).mean((1, 3))


def bilinear(radiance, u, v):
    rows, columns, _ = radiance.shape
    x, y = u * columns - 0.5, np.clip(v * rows - 0.5, 0, rows - 1)
    left, top = np.floor(x).astype(int), np.minimum(np.floor(y).astype(int), rows - 2)
    across, down = (x - left)[..., None], (y - top)[..., None]

    def at(row, column):
        return radiance[row, column % columns]

    upper = at(top, left) * (1 - across) + at(top, left + 1) * across
    lower = at(top + 1, left) * (1 - across) + at(top + 1, left + 1) * across
    return upper * (1 - down) + lower * down


def first_hits(scene, samples, size=SIZE):
    """What the camera sees: shapes, samples² a pixel."""
    columns, rows = size[0] * samples, size[1] * samples
    at = dr.arange(mi.UInt32, columns * rows)
    place = mi.Point2f((mi.Float(at % columns) + 0.5) / columns, (mi.Float(at // columns) + 0.5) / rows)
    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, place, mi.Point2f(0.5))
    return scene.ray_intersect(ray).shape, (size[1], samples, size[0], samples)


def shape_of(scene, name):
    return mi.ShapePtr(next(shape for shape in scene.shapes() if shape.id() == name))


def ground_alone(scene, samples=4, size=SIZE):
    """Pixels through which nothing but ground or panorama is seen."""
    shapes, folded = first_hits(scene, samples, size)
    nothing = (shapes == dr.zeros(mi.ShapePtr)) | (shapes == shape_of(scene, "ground"))
    return np.array(nothing).reshape(folded).all((1, 3))


def regions(scene, objects):
    """Through the middle of each pixel: 0 the panorama, 1 the ground, 2 on the objects in their order."""
    shapes, _ = first_hits(scene, 1)
    region = np.zeros(SIZE[0] * SIZE[1], np.uint8)
    for at, name in enumerate(["ground", *objects]):
        region[np.array(shapes == shape_of(scene, name))] = at + 1
    return region.reshape(SIZE[1], SIZE[0], 1)


def check_conventions():
    """A spot of light in the panorama is seen where its direction is, and casts a shadow to the other side."""
    rows, columns = 128, 256
    for longitude_deg, latitude_deg in [(10, 5), (-20, -3), (0, -20)]:
        longitude, latitude = np.radians(longitude_deg), np.radians(latitude_deg)
        lo = (np.arange(columns) + 0.5) / columns * 2 * np.pi - np.pi
        la = (0.5 - (np.arange(rows) + 0.5) / rows) * np.pi
        spot = direction(lo[None, :], la[:, None]) @ direction(longitude, latitude) > np.cos(np.radians(4))
        radiance = np.repeat(spot[..., None], 3, -1).astype(float)
        scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": camera(), "light": environment(radiance)})
        drawn, expected = np.array(mi.render(scene, spp=256)), seen(radiance, 8)[0]
        off = np.abs(drawn - expected).mean() / expected.mean()
        assert off < 0.05, f"a spot at {longitude_deg}, {latitude_deg} is drawn {off:.3f} off: Mitsuba's environment is turned otherwise"


def encode(linear):
    shown = np.clip(linear, 0, 1)
    coded = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    return np.round(coded * 255).astype(np.uint8)


def write_png(path, codes):
    mi.Bitmap(np.ascontiguousarray(codes)).write(str(path))


def truth(arguments):
    scene_file = tomllib.loads(arguments.scene.read_text())
    report = {}
    for name in arguments.only or PANORAMAS:
        radiance = load_panorama(next(arguments.panoramas.glob(f"*{name}.exr")))
        albedo = np.pi * radiance / ground_irradiance(radiance)
        emitted = radiance * np.maximum(1 - ALBEDO_MOST / np.maximum(albedo, 1e-9), 0)
        albedo = np.minimum(albedo, ALBEDO_MOST)
        emitted[emitted < 1e-3 * radiance] = 0
        base = {"type": "scene", "integrator": {"type": "path", "max_depth": 8}, "sensor": camera(), "light": environment(radiance)}
        base["ground"] = ground(scene_file["ground_y"], albedo, emitted)
        empty = render(mi.load_dict(base))
        objects = {f"object{i}": load_object(item, arguments.scene.parent) for i, item in enumerate(scene_file["object"])}
        scene = mi.load_dict(base | objects)
        runs = render(scene)
        shown, up = seen(radiance)
        alone = ground_alone(scene)[None, ..., None]
        runs = np.where(alone, runs - empty + shown, runs)
        picture = robust_mean(runs)
        below = up < -0.01
        visible = shown[below].sum()
        figures = {
            "empty_ground_over_panorama": float(empty.mean(0)[below].sum() / visible),
            "emitted_share_of_ground": float(seen(emitted)[0][below].sum() / visible),
            "outliers_share": float(1 - picture.mean() / runs.mean()),
            "standard_error": float((runs.std(0, ddof=1) / np.sqrt(RUNS)).mean()),
        }
        report[name] = figures
        print(name, figures, flush=True)
        write_png(arguments.out / f"{name}-truth.png", encode(picture))
        write_png(arguments.out / "regions.png", regions(scene, objects))
    if not arguments.only:
        made_with = {"mitsuba": mi.__version__, "runs": RUNS, "samples": SAMPLES}
        view = {"size": SIZE, "fov_y_deg": FOV_Y_DEG, "pitch_deg": PITCH_DEG}
        kept = {"made_with": made_with, "view": view, "regions": ["panorama", "ground", *REGIONS], "panoramas": report}
        (arguments.out / "truth.json").write_text(json.dumps(kept, indent=1) + "\n")


def lamp(elevation_deg, azimuth_deg, solid_angle, share):
    """A distant disc, and what the viewer is told of it: level ground receives `share` of it."""
    towards = direction(np.radians(azimuth_deg), np.radians(elevation_deg))
    radius = np.tan(np.arccos(1 - solid_angle / (2 * np.pi))) * DISTANCE_M
    at = (towards * DISTANCE_M).tolist()
    to_world = mi.ScalarTransform4f().look_at(origin=at, target=[0, 0, 0], up=[0, 1, 0]).scale([radius, radius, 1])
    radiance = share / (solid_angle * towards[1])
    disc = {"type": "disk", "to_world": to_world, "emitter": {"type": "area", "radiance": rgb([radiance] * 3)}}
    told = {"direction": towards.tolist(), "irradiance": [share / towards[1]] * 3, "solid_angle_sr": solid_angle}
    return disc, told


def shadows(arguments):
    counts = {}
    for path in sorted(arguments.scenes.glob("*.toml")):
        scene_file = tomllib.loads(path.read_text())
        objects = {f"object{i}": load_object(item, path.parent) for i, item in enumerate(scene_file["object"])}
        for count in LIGHT_COUNTS:
            lamps = [lamp(*light, 1 / count) for light in LIGHTS[:count]]
            base = {"type": "scene", "integrator": {"type": "direct"}, "sensor": camera(*SHADOW_VIEW)}
            base["ground"] = ground(scene_file["ground_y"], np.ones((2, 4, 3)))
            base |= {f"lamp{i}": disc for i, (disc, _) in enumerate(lamps)}
            scene = mi.load_dict(base | objects)
            shadowed, lit = render(scene).mean((0, 3)), render(mi.load_dict(base)).mean((0, 3))
            visible = np.where(lit > 0, shadowed / np.maximum(lit, 1e-9), 1)
            alone = ground_alone(scene, size=SHADOW_VIEW[0])
            codes = np.stack([np.clip(visible, 0, 1) * 255 * alone, alone * 255], -1).round().astype(np.uint8)
            bitmap = mi.Bitmap(np.ascontiguousarray(codes), mi.Bitmap.PixelFormat.YA)
            bitmap.write(str(arguments.scenes / f"{path.stem}-{count}.png"))
            counts[count] = [told for _, told in lamps]
            print(path.stem, count, "shadow", float((visible < 0.5).mean()), flush=True)
    view = dict(zip(["size", "fov_y_deg", "pitch_deg"], SHADOW_VIEW))
    (arguments.scenes / "shadows.json").write_text(json.dumps({"view": view, "lights": counts}, indent=1) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("truth", help="pictures under the panoramas")
    command.add_argument("--panoramas", type=Path, required=True, help="folder of the .exr files")
    command.add_argument("--scene", type=Path, required=True)
    command.add_argument("--out", type=Path, required=True)
    command.add_argument("--only", nargs="*", help="names of panoramas; truth.json is left as it is")
    command.set_defaults(run=truth)
    command = commands.add_parser("shadows", help="visibility of the lamps on the ground, for every .toml of a folder")
    command.add_argument("--scenes", type=Path, required=True)
    command.set_defaults(run=shadows)
    arguments = parser.parse_args()
    check_conventions()
    arguments.run(arguments)
