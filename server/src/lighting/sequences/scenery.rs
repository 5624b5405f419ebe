//! What the scene holds besides its light: clipped clouds, grey skies, windows, puddles, people.

use std::f32::consts::TAU;

use glam::Vec3;

use super::{Disc, SUN, Scene, Sequence, sun};

/// A clipped sky grows from 0.05 to 0.6 of the upper hemisphere.
#[must_use]
pub fn clipped_share() -> Sequence {
    Sequence::new("clipped share", 4.0, |time| {
        let share = 0.05 + 0.55 * time / 4.0;
        let radius = (1.0 - share).acos();
        let disc = Disc { centre: Vec3::Y, radius, radiance: Vec3::splat(3.0) };
        Scene { sky: Vec3::splat(0.08), ..Scene::new(vec![disc]) }
    })
}

/// A sun under a clipped cloud bank on the other side of the sky, which grows from 0.05 to 0.6 of the upper hemisphere: in what is left of them by
/// clipping, area outweighs the sun.
#[must_use]
pub fn clipped_clouds() -> Sequence {
    Sequence::new("clipped clouds", 4.0, |time| {
        let share = 0.05 + 0.55 * time / 4.0;
        let bank = Disc { radius: (1.0 - share).acos(), ..Disc::at(-140.0, 70.0, 0.0, Vec3::splat(1.3)) };
        Scene { sky: Vec3::splat(0.08), ..Scene::new(vec![sun(40.0, 33.0), bank]) }
    })
}

/// A lamp whose middle wavers about white over bright ground: now and then a pixel or two of it are clipped.
#[must_use]
pub fn clipped_speck() -> Sequence {
    let sequence = Sequence::new("clipped speck", 4.0, |time| {
        let radiance = Vec3::splat(0.92 + 0.07 * (TAU * 1.1 * time).sin());
        Scene { ground: Vec3::splat(0.3), ..Scene::new(vec![Disc::at(40.0, 50.0, 1.0, radiance)]) }
    });
    sequence.grained(2.0)
}

/// A sky without a sun, coarse grain.
#[must_use]
pub fn overcast() -> Sequence {
    let sequence = Sequence::new("overcast", 4.0, |_| Scene { sky: Vec3::splat(0.35), ..Scene::new(Vec::new()) });
    sequence.grained(4.0)
}

/// An even sky near white, whose coarse grain clips one texel in forty, another set in every frame.
#[must_use]
pub fn even_overcast() -> Sequence {
    let scene = |_| Scene { sky: Vec3::splat(0.93), ground: Vec3::splat(0.2), texture: 0.0, ..Scene::new(Vec::new()) };
    Sequence::new("even overcast", 4.0, scene).grained(4.0)
}

/// A clipped window in a dim room, and the light that falls in: a wide patch of floor that turns from grey to red within a second, and back.
#[must_use]
pub fn window_with_bounce() -> Sequence {
    Sequence::new("window with bounce", 8.0, |time| {
        let red = (time - 2.0).clamp(0.0, 1.0) - (time - 5.0).clamp(0.0, 1.0);
        let floor = Vec3::splat(0.12).lerp(Vec3::new(0.75, 0.2, 0.1), red);
        let window = Disc::at(60.0, 12.0, 9.0, Vec3::new(3.2, 3.5, 4.0));
        let things = vec![Disc::at(60.0, -48.0, 28.0, floor)];
        Scene { things, sky: Vec3::splat(0.08), ground: Vec3::splat(0.05), ..Scene::new(vec![window]) }
    })
}

/// A low sun and its image in wet ground, which the wind ruffles from a third of the sun's radiance to a two-hundredth and back.
#[must_use]
pub fn wet_ground() -> Sequence {
    Sequence::new("wet ground", 6.0, |time| {
        let ruffled = 0.5 - 0.5 * (TAU * 0.4 * time).cos();
        let image = Disc { radiance: SUN * 0.3 * (-4.0 * ruffled).exp(), ..Disc::at(40.0, -25.0, 4.5, SUN) };
        Scene::new(vec![sun(40.0, 25.0), image])
    })
}

/// People in a dark coat, a white shirt and a red one walk, stop after two and a half seconds, and walk on after five.
#[must_use]
pub fn people() -> Sequence {
    Sequence::new("people", 7.0, |time| {
        let along = 12.0 * (time.min(2.5) + (time - 5.0).max(0.0));
        let clothes = [Vec3::splat(0.01), Vec3::splat(0.96), Vec3::new(0.6, 0.05, 0.04)];
        let things = clothes.iter().zip([0.0, 100.0, 215.0]).map(|(clothes, from)| Disc::at(from + along, -8.0, 7.0, *clothes));
        Scene { things: things.collect(), ..Scene::new(vec![sun(40.0, 50.0)]) }
    })
}
