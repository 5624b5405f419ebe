//! What the viewer draws, held against path-traced references by `mr360-bench render`.

use std::process::Command;

use anyhow::{Context, Result, ensure};
use mr360_tests::sandbox::Sandbox;

/// Ours has to look less wrong than three.js's pictures on this many of the eight panoramas.
const LOWER_ON: usize = 7;
/// Mean share of wrong shadow pixels that is bearable.
const SHADOW_ERROR: f64 = 0.04;

/// Runs one part of the bench and returns the rows of a table that it writes.
fn bench(part: &str, table: &str) -> Result<Vec<Vec<String>>> {
    let folder = tempfile::tempdir()?;
    let output = Command::new(env!("CARGO_BIN_EXE_mr360-bench")).args(["render", "--part", part, "--out"]).arg(folder.path()).output()?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = std::fs::read_to_string(folder.path().join(table))?;
    let rows: Vec<Vec<String>> = text.lines().skip(1).map(|line| line.split(',').map(str::to_owned).collect()).collect();
    ensure!(!rows.is_empty() && folder.path().join("render.md").is_file(), "{table} is empty");
    Ok(rows)
}

fn figure(row: &[String], column: usize) -> Result<f64> {
    row.get(column).and_then(|cell| cell.parse().ok()).with_context(|| format!("no figure {column} in {row:?}"))
}

#[test]
fn pictures_are_closer_to_the_truth_than_those_of_three_js() -> Result<()> {
    let rows = bench("truth", "render-truth.csv")?;
    ensure!(rows.len() == 16, "{} rows", rows.len());
    let pairs = rows.chunks_exact(2).map(|pair| {
        ensure!(pair[0][0] == pair[1][0] && pair[0][1] == "ours" && pair[1][1] == "three.js", "{pair:?}");
        Ok(figure(&pair[0], 2)? < figure(&pair[1], 2)?)
    });
    let lower = pairs.collect::<Result<Vec<_>>>()?.into_iter().filter(|lower| *lower).count();
    ensure!(lower >= LOWER_ON, "lower FLIP on {lower} of 8 panoramas only: {rows:?}");
    Ok(())
}

#[test]
fn shadows_lie_where_traced_light_leaves_them() -> Result<()> {
    let rows = bench("shadows", "render-shadows.csv")?;
    ensure!(rows.len() == 9, "{} rows", rows.len());
    let errors = rows.iter().map(|row| figure(row, 4)).collect::<Result<Vec<_>>>()?;
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    ensure!(mean <= SHADOW_ERROR, "mean shadow error {mean}: {rows:?}");
    Ok(())
}

#[test]
fn every_pass_of_a_picture_is_timed() -> Result<()> {
    let sandbox = Sandbox::new()?;
    image::RgbImage::from_pixel(64, 32, image::Rgb([200; 3])).save(sandbox.path("even.png"))?;
    std::fs::write(sandbox.path("SCENE.toml"), "ground_y = -1.6\n[[object]]\nshape = \"sphere\"\nposition = [0.0, -1.1, -3.0]\n")?;
    let render = |passes: &str| -> Result<std::process::Output> {
        let mut command = sandbox.client_command()?;
        command.args([
            "render",
            "--panorama",
            "even.png",
            "--scene",
            "SCENE.toml",
            "--size",
            "64x36",
            "--out",
            "out.png",
            "--passes",
            passes,
        ]);
        Ok(command.output()?)
    };
    let output = render("passes.csv")?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = std::fs::read_to_string(sandbox.path("passes.csv"))?;
    let passes: Vec<_> = text.lines().filter_map(|line| line.rsplit_once(',')).collect();
    ensure!(passes.first() == Some(&("pass", "gpu_ms")), "{text}");
    for name in ["objects", "composite"] {
        let time = passes.iter().find(|(pass, _)| *pass == name).and_then(|(_, ms)| ms.parse::<f64>().ok());
        ensure!(time.is_some_and(|ms| ms > 0.0), "{name}: {text}");
    }
    let output = render("nowhere/passes.csv")?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.code() == Some(2) && said.contains("nowhere/passes.csv"), "{}: {said}", output.status);
    Ok(())
}
