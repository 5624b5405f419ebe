//! What is sent: lights, and SH of all that they do not hold.
//!
//! The panorama in the exposure that is sent, with every observed light at its followed direction and intensity in place of what the frame happens to show,
//! holds the energy of the frame up to what was smoothed away. The lights that are sent are taken out of its SH as clients
//! put them back, as sources without extent. So lights plus SH hold the energy once whatever part of a light is sent, and
//! what wavers in a light does not come back with the opposite sign through the SH. What a lamp holds below the threshold stays in
//! the SH and wavers with it, so it is scaled as the light is.
//!
//! A source without extent is a poor picture of a wide light: taken out whole it leaves negative irradiance behind, which
//! clients clamp. No light is therefore sent stronger than what the surfaces facing it receive.

use glam::{DVec3, Vec3};
use mr360_protocol::light::{DirectionalLight, SH9, SH25};
use mr360_shaders::sh::{IRRADIANCE_BAND, basis25};

use super::assign::MOST;
use super::life::{Track, canonical};
use super::{Estimate, Gains, LUMA, View};

/// Irradiance that bands 0 to 2 give on a surface facing a light of irradiance 1: ¼ + ½ + 5/16.
const FACING: f64 = 1.0625;
/// A light out of sight may still be in the picture, up to this angle beyond its rim: the reach of a coarse texel's
/// corner.
const REACH: f64 = 0.07;

/// What is followed may differ from what is seen by this factor: half a beat, or a frame of a change. More than that is something else.
const MOST_FOLLOWED: f64 = 2.0;

/// One light to be sent.
#[derive(Debug, Clone, Copy)]
struct Sent {
    id: u32,
    direction: Vec3,
    irradiance: DVec3,
    solid_angle_sr: f64,
}

/// Bands 3 and 4 are sent from the frame on in which band 4 makes up this share of the irradiance, root mean square over the sphere to mean: a
/// fifth of what is seen (Weber's 2 %). Irradiance has no band 3 (Ramamoorthi & Hanrahan 2001). They go on until the next cut, so that nothing
/// comes and goes with them.
const WORTH: f64 = 0.004;

/// Makes what is sent; the buffer is reused.
#[derive(Default)]
pub(super) struct Lights {
    sent: Vec<Sent>,
    /// Whether bands 3 and 4 are sent.
    fine: bool,
}

/// SH in double precision, so that taking out what was put in leaves nothing.
struct Harmonics([DVec3; SH25]);

impl Harmonics {
    fn add(&mut self, direction: Vec3, irradiance: DVec3) {
        for (sum, basis) in self.0.iter_mut().zip(basis25(direction)) {
            *sum += irradiance * f64::from(basis);
        }
    }

    /// Share of the luminous irradiance that is band 4's, root mean square over mean; `direct` is the lights' irradiance on surfaces that face them.
    fn fourth_band_share(&self, direct: f64) -> f64 {
        let fourth: f64 = self.0[16..].iter().map(|c| c.dot(LUMA).powi(2)).sum();
        // An orthonormal function has the root mean square 1/√4π; of a light, a quarter reaches the mean surface.
        let root = (4.0 * std::f64::consts::PI).sqrt();
        let mean = f64::from(IRRADIANCE_BAND[0]) * self.0[0].dot(LUMA) / root + 0.25 * direct;
        if mean > 0.0 { f64::from(IRRADIANCE_BAND[4]).abs() * fourth.sqrt() / root / mean } else { 0.0 }
    }
}

impl Lights {
    /// Forgets what was sent.
    pub(super) fn reset(&mut self) {
        self.fine = false;
    }

    /// Writes lights and SH into `estimate`; at most `most` lights, strongest first.
    pub(super) fn send(&mut self, tracks: &[Track], view: &View<'_>, gains: Gains, most: usize, estimate: &mut Estimate) {
        self.choose(tracks, view, gains, most);
        let scale = gains.sent / gains.measured;
        let mut sh = Harmonics(view.sh.map(|coefficient| coefficient.as_dvec3() * scale));
        for track in tracks {
            if let Some(seen) = &track.seen {
                // As it is followed, with the floor under its channels: what is put in is then what is taken out.
                let shown = canonical(seen.irradiance, gains).exp() * gains.sent;
                sh.add(seen.direction.as_vec3(), -shown);
                sh.add(track.direction.value().as_vec3(), irradiance(track, gains));
                // What was guessed says nothing of what is seen.
                let followed = (irradiance(track, gains).dot(LUMA) / shown.dot(LUMA)).clamp(1.0 / MOST_FOLLOWED, MOST_FOLLOWED);
                sh.add(seen.direction.as_vec3(), seen.pedestal * scale * ((followed - 1.0) * (1.0 - seen.hidden_share)));
            }
        }
        for light in &self.sent {
            sh.add(light.direction, -light.irradiance);
        }
        for light in &mut self.sent {
            let spread = light.irradiance * (1.0 - received_share(light.solid_angle_sr));
            light.irradiance -= spread;
            sh.add(light.direction, spread);
        }
        estimate.sh.clear();
        let direct = self.sent.iter().map(|light| light.irradiance.dot(LUMA)).sum();
        self.fine |= sh.fourth_band_share(direct) > WORTH;
        estimate.sh.reserve(SH25);
        estimate.sh.extend(sh.0[..if self.fine { SH25 } else { SH9 }].iter().map(|coefficient| coefficient.as_vec3()));
        estimate.lights.clear();
        estimate.lights.reserve(most);
        estimate.lights.extend(self.sent.iter().filter(|light| light.irradiance.max_element() > 0.0).map(|light| DirectionalLight {
            id: light.id,
            direction: light.direction,
            irradiance: light.irradiance.as_vec3(),
            solid_angle_sr: light.solid_angle_sr as f32,
        }));
        estimate.lights.sort_unstable_by(|a, b| b.irradiance.dot(LUMA.as_vec3()).total_cmp(&a.irradiance.dot(LUMA.as_vec3())));
    }

    /// The lights as the tracks would have them.
    fn choose(&mut self, tracks: &[Track], view: &View<'_>, gains: Gains, most: usize) {
        self.sent.clear();
        self.sent.reserve(MOST);
        for track in tracks {
            let Some(id) = track.id.filter(|_| track.weight > 0.0) else { continue };
            let (irradiance, direction) = with_kin(track, tracks, view, gains);
            self.sent.push(Sent { id, direction: direction.as_vec3().normalize(), irradiance, solid_angle_sr: track.solid_angle_sr() });
        }
        self.sent.sort_unstable_by(|a, b| b.irradiance.dot(LUMA).total_cmp(&a.irradiance.dot(LUMA)));
        self.sent.truncate(most);
    }
}

/// What bands 0 to 2 of a disc of this solid angle give on a surface facing it, as a share of what they give of a source
/// without extent: a zonal cap keeps 1, (1 + c)/2 and c(1 + c)/2 of its bands, c being the cosine of its radius.
fn received_share(solid_angle_sr: f64) -> f64 {
    let cosine = (1.0 - solid_angle_sr / std::f64::consts::TAU).clamp(0.0, 1.0);
    let half = 0.5 * (1.0 + cosine);
    (0.25 + 0.5 * half + 0.3125 * cosine * half) / FACING
}

/// Followed irradiance in the exposure that is sent.
fn irradiance(track: &Track, gains: Gains) -> DVec3 {
    track.intensity.value().exp() * gains.sent
}

/// The part of a track that is sent as its own light. What is out of sight is not sent stronger than what the picture
/// still holds around its direction.
fn own(track: &Track, view: &View<'_>, gains: Gains) -> DVec3 {
    let sent = irradiance(track, gains) * track.weight;
    // What ran into its kin is in the picture under the kin's name.
    if track.seen.is_some() || track.kin.is_some() {
        return sent;
    }
    let cosine = (track.radius() + REACH).cos() as f32;
    sent.min(view.coarse.within(track.direction.value().as_vec3(), cosine) * gains.sent / gains.measured)
}

/// Irradiance and direction of a track's light: its own, and what it holds of those that come out of it or ran into it.
fn with_kin(track: &Track, tracks: &[Track], view: &View<'_>, gains: Gains) -> (DVec3, DVec3) {
    let mut sum = own(track, view, gains);
    let mut vector = track.direction.value() * sum.dot(LUMA);
    for other in tracks.iter().filter(|other| other.kin.is_some() && other.kin == track.id) {
        let whole = irradiance(other, gains);
        let held = if other.seen.is_some() { whole * (1.0 - other.weight) } else { whole * -other.weight };
        sum += held;
        vector += other.direction.value() * held.dot(LUMA);
    }
    (sum.max(DVec3::ZERO), vector.try_normalize().unwrap_or(track.direction.value()))
}

#[cfg(test)]
mod tests {
    use mr360_shaders::sh::band;

    use super::super::{Bounds, Coarse, Observation, life};
    use super::*;

    /// SH of a disc of radiance 1 about the zenith, and its energy.
    fn disc(radius: f64) -> ([Vec3; SH25], f64) {
        let (energy, cosine) = (std::f64::consts::TAU * (1.0 - radius.cos()), radius.cos());
        // Of a zonal cap, the bands keep this much of what a source without extent has: (P(l−1) − P(l+1))/((2l+1)(1 − c)).
        let (half, c2) = (0.5 * (1.0 + cosine), cosine * cosine);
        let kept = [1.0, half, cosine * half, 0.25 * half * (5.0 * c2 - 1.0), 0.25 * cosine * half * (7.0 * c2 - 3.0)];
        let mut index = 0..;
        let sh = basis25(Vec3::Y).map(|basis| Vec3::splat((f64::from(basis) * energy * kept[band(index.next().unwrap())]) as f32));
        (sh, energy)
    }

    /// What is sent when a disc is observed whole.
    fn sent(radius: f64) -> (Estimate, [Vec3; SH25]) {
        let (sh, energy) = disc(radius);
        let seen = Observation {
            direction: DVec3::Y,
            irradiance: DVec3::splat(energy),
            pedestal: DVec3::ZERO,
            solid_angle_sr: energy,
            share: 1.0,
            hidden_share: 0.0,
            sigma: 0.0,
        };
        let gains = Gains { measured: DVec3::ONE, sent: DVec3::ONE };
        let bounds = Bounds { birth: 0.04, death: 0.02, lights: 8 };
        let mut tracks = Vec::new();
        let shown = life::Shown { observations: &[seen], matched: [None; MOST], gains, dt_s: 0.0 };
        life::observe(&mut tracks, &shown, bounds);
        life::decide(&mut tracks, bounds, &mut 0, None);
        let view = View { pts_us: 0, coarse: &Coarse::default(), hdr: true, sh: &sh, observations: &[seen] };
        let mut estimate = Estimate::default();
        Lights::default().send(&tracks, &view, gains, 8, &mut estimate);
        (estimate, sh)
    }

    #[test]
    fn no_light_is_stronger_than_what_the_surface_facing_it_receives() {
        for radius in [0.05, 0.5, 0.9, 1.2] {
            let (estimate, sh) = sent(radius);
            let light = estimate.lights[0].irradiance.x;
            let facing = mr360_shaders::sh::irradiance(&sh[..SH9], Vec3::Y).x;
            assert!((light - facing / FACING as f32).abs() < 1e-4 * light, "{radius}: {light} {facing}");
            let left: f32 =
                estimate.sh.iter().take(SH9).zip(basis25(Vec3::Y)).enumerate().map(|(i, (c, y))| c.x * y * IRRADIANCE_BAND[band(i)]).sum();
            assert!(left.abs() < 1e-4 * light, "{radius}: {left}");
            // What the light does not hold is in the SH.
            let energy = light + estimate.sh[0].x * (4.0 * std::f32::consts::PI).sqrt();
            assert!((energy - disc(radius).1 as f32).abs() < 1e-4 * energy, "{radius}");
        }
    }
}
