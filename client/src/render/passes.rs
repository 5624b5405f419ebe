//! `--passes`: what each pass of the GPU takes.

use anyhow::anyhow;
use glam::Quat;

use super::{Methods, Still, running, target};
use crate::Failure;
use crate::camera::Camera;
use crate::stats::PassTime;
use crate::view::View;

/// Frames that `--passes` times, and those before them, which fill caches; times come back two frames late.
const TIMED_FRAMES: usize = 5;
const UNTIMED_FRAMES: usize = 3;
/// By which lights turn from one of these frames to the next, so that nothing that depends on them is kept.
const TURN_RAD: f32 = 1e-3;

impl Still<'_> {
    /// GPU time of every pass, the median over frames that each bring a new picture and lights that moved.
    ///
    /// # Errors
    /// As [`Still::draw`], and [`Failure::Running`] for a GPU that cannot time its passes.
    pub fn time_passes(&self, methods: Methods, camera: &Camera, size: (u32, u32)) -> Result<Vec<PassTime>, Failure> {
        let (gpu, format) = (self.gpu, wgpu::TextureFormat::Rgba8UnormSrgb);
        let (mut environment, mut renderer) = self.set_up(methods, format)?;
        let view = target(gpu, size, format).create_view(&wgpu::TextureViewDescriptor::default());
        let mut light = self.light.clone();
        let mut frames = Vec::with_capacity(TIMED_FRAMES);
        for frame in 0..UNTIMED_FRAMES + TIMED_FRAMES {
            environment.upload(gpu, self.picture).map_err(|error| Failure::Input(error.into()))?;
            light.lights.iter_mut().for_each(|light| light.direction = Quat::from_rotation_y(TURN_RAD) * light.direction);
            renderer.set_light(&light);
            let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            let report = renderer.render(gpu, &mut encoder, &mut environment, &[View { camera: *camera, target: &view, size }]);
            gpu.queue.submit([encoder.finish()]);
            gpu.wait().map_err(running)?;
            if frame >= UNTIMED_FRAMES {
                frames.push(report.passes);
            }
        }
        let times = medians(&frames);
        if times.is_empty() {
            return Err(Failure::Running(anyhow!("--passes: this GPU has no timestamps; leave the option out")));
        }
        Ok(times)
    }
}

/// The median time of each pass of the last frame over all frames that have it.
fn medians(frames: &[Vec<PassTime>]) -> Vec<PassTime> {
    let median = |name: &'static str| {
        let mut times: Vec<f32> = frames.iter().flatten().filter(|pass| pass.name == name).map(|pass| pass.gpu_ms).collect();
        times.sort_unstable_by(f32::total_cmp);
        PassTime { name, gpu_ms: times.get(times.len() / 2).copied().unwrap_or_default() }
    };
    frames.last().into_iter().flatten().map(|pass| median(pass.name)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_middle_time_of_every_pass_counts() {
        let frame =
            |shadow, composite| [("shadow 1", shadow), ("composite", composite)].map(|(name, gpu_ms)| PassTime { name, gpu_ms }).to_vec();
        let late = vec![PassTime { name: "shadow 1", gpu_ms: 9.0 }];
        let times = medians(&[late, frame(1.0, 5.0), frame(3.0, 4.0), frame(2.0, 6.0)]);
        assert_eq!(times, frame(3.0, 5.0));
        assert!(medians(&[]).is_empty());
    }
}
