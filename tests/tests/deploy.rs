//! What the entry scripts hand to the programs is valid.

use std::fs;
use std::path::Path;

use mr360_protocol::asset::AssetId;
use mr360_protocol::scene_file::SceneFile;

const DEMO_SCENE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/demo-scene/SCENE.toml");

#[test]
fn the_demo_scene_loads_and_each_of_its_models_has_its_licence_noted() {
    let file = SceneFile::load(Path::new(DEMO_SCENE)).unwrap();
    let notes = fs::read_to_string(Path::new(DEMO_SCENE).with_file_name("LICENCES.md")).unwrap();
    let scene = file.resolve(|model| fs::read(model).map(|bytes| AssetId::of(&bytes))).unwrap();
    assert_eq!(file.models().len(), 1);
    for asset in scene.assets() {
        assert!(notes.contains(&asset.to_string()), "{asset} is not in LICENCES.md");
    }
}
