//! What frames take: `--passes`, each pass on the GPU; `--frame-times`, whole frames.

use std::time::{Duration, Instant};

use anyhow::anyhow;
use glam::{Quat, Vec3};

use super::layers::Layers;
use super::{How, Still, running};
use crate::Failure;
use crate::camera::Camera;
use crate::stats::PassTime;
use crate::view::{FrameReport, MAX_VIEWS};

/// Frames that `--passes` times: as many as hold reflections of every tier equally often.
const TIMED_FRAMES: usize = 8;
/// Frames before those that are timed, which make pipelines and fill caches; times of passes come back two frames late.
const UNTIMED_FRAMES: usize = 3;
/// By which lights turn from one new picture to the next, so that nothing that depends on them is kept.
const TURN_RAD: f32 = 1e-3;
/// Between the views of a frame, metres: as far apart as eyes are.
const EYE_DISTANCE_M: f32 = 0.064;

/// The frames that are timed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Timed {
    /// Of the first view.
    pub camera: Camera,
    /// Of every view's picture.
    pub size: (u32, u32),
    /// Views drawn in every frame, 1 to [`MAX_VIEWS`], side by side as eyes are.
    pub views: usize,
}

/// What frames took, milliseconds each.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameTimes {
    /// Of a still picture: only the view is drawn.
    pub still_ms: Vec<f64>,
    /// Each with a new picture, and lights that moved.
    pub new_picture_ms: Vec<f64>,
}

impl Still<'_> {
    /// GPU time of every pass a frame, over frames that each bring a new picture and lights that moved: the median over the frames that have
    /// the pass, times their share of all frames.
    ///
    /// # Errors
    /// As [`Still::draw`], and [`Failure::Running`] for a GPU that cannot time its passes.
    pub fn time_passes(&self, how: How, timed: Timed) -> Result<Vec<PassTime>, Failure> {
        let frames = self.run(how, timed, true, TIMED_FRAMES)?;
        let times = shares(&frames.into_iter().map(|(report, _)| report.passes).collect::<Vec<_>>());
        if times.is_empty() {
            return Err(Failure::Running(anyhow!("--passes: this GPU has no timestamps; leave the option out")));
        }
        Ok(times)
    }

    /// Time of `count` frames of each kind from their first command to their end on the GPU, one after the other.
    ///
    /// # Errors
    /// As [`Still::draw`].
    pub fn time_frames(&self, how: How, timed: Timed, count: usize) -> Result<FrameTimes, Failure> {
        let times = |new_pictures| -> Result<Vec<f64>, Failure> {
            let frames = self.run(how, timed, new_pictures, count)?;
            Ok(frames.iter().map(|(_, time)| time.as_secs_f64() * 1e3).collect())
        };
        Ok(FrameTimes { still_ms: times(false)?, new_picture_ms: times(true)? })
    }

    /// Draws frames and waits for each.
    fn run(&self, how: How, timed: Timed, new_pictures: bool, count: usize) -> Result<Vec<(FrameReport, Duration)>, Failure> {
        let (gpu, format) = (self.gpu, wgpu::TextureFormat::Rgba8UnormSrgb);
        let cameras: Vec<Camera> = (0..timed.views.clamp(1, MAX_VIEWS)).map(|at| beside(&timed.camera, at)).collect();
        let (mut environment, mut renderer) = self.set_up(how, cameras.len(), format)?;
        let layers = Layers::new(gpu, timed.size, cameras.len(), format);
        let mut light = self.light.clone();
        let mut frames = Vec::with_capacity(count);
        for frame in 0..UNTIMED_FRAMES + count {
            let begin = Instant::now();
            if new_pictures {
                environment.upload(gpu, self.picture).map_err(|error| Failure::Input(error.into()))?;
                light.lights.iter_mut().for_each(|light| light.direction = Quat::from_rotation_y(TURN_RAD) * light.direction);
                renderer.set_light(&light);
            }
            let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            let report = layers.render(gpu, &mut encoder, &mut environment, &mut renderer, &cameras);
            gpu.queue.submit([encoder.finish()]);
            gpu.wait().map_err(running)?;
            if frame >= UNTIMED_FRAMES {
                frames.push((report, begin.elapsed()));
            }
        }
        Ok(frames)
    }
}

/// The camera of the so manieth view, to the right of the first.
fn beside(first: &Camera, at: usize) -> Camera {
    let aside = first.world_from_view * Vec3::X * (at as f32 * EYE_DISTANCE_M);
    Camera { position: first.position + aside, right_eye: first.right_eye || at % 2 == 1, ..*first }
}

/// The median time of each pass over the frames that have it, times their share; passes in the order in which they first appear.
fn shares(frames: &[Vec<PassTime>]) -> Vec<PassTime> {
    let mut names: Vec<&'static str> = Vec::new();
    for pass in frames.iter().flatten() {
        if !names.contains(&pass.name) {
            names.push(pass.name);
        }
    }
    let share = |name: &'static str| {
        let mut times: Vec<f32> = frames.iter().flatten().filter(|pass| pass.name == name).map(|pass| pass.gpu_ms).collect();
        times.sort_unstable_by(f32::total_cmp);
        let median = times.get(times.len() / 2).copied().unwrap_or_default();
        PassTime { name, gpu_ms: median * times.len() as f32 / frames.len().max(1) as f32 }
    };
    names.into_iter().map(share).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_middle_time_of_every_pass_counts_as_often_as_it_runs() {
        let frame = |passes: &[(&'static str, f32)]| passes.iter().map(|(name, gpu_ms)| PassTime { name, gpu_ms: *gpu_ms }).collect();
        let composite = |ms| frame(&[("composite", ms)]);
        let times = shares(&[composite(5.0), composite(4.0), frame(&[("reflections", 8.0), ("composite", 7.0)]), composite(6.0)]);
        assert_eq!(times, frame(&[("composite", 6.0), ("reflections", 2.0)]));
        assert!(shares(&[]).is_empty());
    }

    #[test]
    fn views_lie_side_by_side_across_the_line_of_sight() {
        let first = Camera::looking(1.0, -0.5, 1.0);
        let [left, right] = [0, 1].map(|at| beside(&first, at));
        assert_eq!((left, right.right_eye), (first, true));
        let aside = right.position - left.position;
        assert!((aside.length() - EYE_DISTANCE_M).abs() < 1e-6 && aside.y.abs() < 1e-6);
        assert!(aside.dot(first.world_from_view * Vec3::Z).abs() < 1e-6);
    }
}
