//! The light probe of three.js in Node, as a process that is raced with our methods.
//!
//! `tests/peers/three_light_probe.mjs` says how it works and what it is asked for. Its conventions are checked each time it is started, so
//! that no error of ours, nor a change of theirs, is charged to its accuracy.

use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result, ensure};
use glam::Vec3;
use mr360_protocol::light::Lift;
use mr360_shaders::sh::basis9;

use super::exposure::{Exposure, Taken};
use super::peer::{Introduction, Peer};
use super::radiance_map::RadianceMap;

/// Travels inside this program, so that it works wherever the program lies.
const SCRIPT: &str = include_str!("../../peers/three_light_probe.mjs");
/// Name in tables.
pub(super) const NAME: &str = "three-light-probe";
/// Cosine of the radius of the spot that conventions are checked with: 6°, and its solid angle.
const SPOT: (f32, f32) = (0.994_522, 0.034_419);

/// Starts it with Node, in a folder that has three.js among its `node_modules`, and checks its conventions.
///
/// # Errors
/// When Node does not start, finds no three.js, or a spot of light is not answered with its harmonics.
pub(super) fn start(node: &Path, folder: &Path) -> Result<Peer> {
    let hint = || {
        let (node, folder) = (node.display(), folder.display());
        format!("--three {folder}: wants a folder in which `npm install three` was run, and Node 18 or newer (--node {node})")
    };
    let mut command = Command::new(node);
    command.args(["--input-type=module", "-e", SCRIPT]).current_dir(folder);
    let introduction = Introduction { name: NAME, lift: Lift::Linear, reads_radiance: true };
    let mut peer = Peer::start(introduction, &mut command).with_context(hint)?;
    check(&mut peer).with_context(hint)?;
    Ok(peer)
}

/// A spot of light in a dark panorama has the harmonics of its direction, times its radiance and solid angle.
fn check(peer: &mut Peer) -> Result<()> {
    for direction in [Vec3::new(0.8, 0.5, 0.3), Vec3::new(-0.3, -0.9, 0.4), Vec3::new(0.2, 0.1, -1.0)].map(Vec3::normalize) {
        let radiance = Vec3::new(1.0, 0.5, 0.25);
        let map = RadianceMap::of(128, |d| if d.dot(direction) > SPOT.0 { radiance } else { Vec3::ZERO });
        let codes = map.texels().iter().map(|texel| texel.to_array().map(super::exposure::code)).collect();
        let hdr = Exposure::Hdr.take(&map)?;
        for taken in [Taken { codes: Some(codes), scale: 1.0, ..Exposure::Hdr.take(&map)? }, hdr] {
            peer.take(&taken, map.texels(), map.width)?;
            peer.run()?;
            let light = peer.light()?;
            let expected = basis9(direction).map(|value| radiance * value * SPOT.1);
            ensure!(light.sh.len() == expected.len(), "it answered {} coefficients", light.sh.len());
            // Pixels of 1.4° draw a disc of 12° across to a few per cent.
            let off = light.sh.iter().zip(expected).map(|(got, expected)| (*got - expected).length()).fold(0.0, f32::max);
            let most = 0.06 * radiance.length() * SPOT.1;
            ensure!(off < most, "a spot at {direction} is answered with {:?}, not {expected:?}: its conventions are others", light.sh);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_or_a_node_that_is_not_there_is_named() {
        let folder = tempfile::tempdir().unwrap();
        for (node, folder) in [("/no/such/node", folder.path()), ("/bin/false", folder.path()), ("node", Path::new("/no/such/folder"))] {
            let error = format!("{:#}", start(Path::new(node), folder).err().unwrap());
            assert!(error.contains(&folder.display().to_string()) && error.contains("npm install three"), "{error}");
        }
    }

    #[test]
    fn a_peer_with_other_conventions_is_refused() {
        // Answers every frame with even light.
        let even = r#"echo v1; while read -r what w h; do case $what in frame) head -c $((w*h*3)) >/dev/null; echo ok;;
            radiance) head -c $((w*h*12)) >/dev/null; echo ok;; run) echo 1;;
            light) echo '{"sh": [[1,1,1],[0,0,0],[0,0,0],[0,0,0],[0,0,0],[0,0,0],[0,0,0],[0,0,0],[0,0,0]], "lights": []}';; esac; done"#;
        let introduction = Introduction { name: NAME, lift: Lift::Linear, reads_radiance: true };
        let mut peer = Peer::start(introduction, Command::new("sh").args(["-c", even])).unwrap();
        assert!(check(&mut peer).unwrap_err().to_string().contains("conventions"));
    }
}
