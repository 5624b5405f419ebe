//! Changes in order, and every range guarded.

use super::*;
use proptest::prelude::*;

fn object(id: u32) -> Object {
    let geometry = Geometry::Shape(Shape::Cube);
    Object { id: ObjectId(id), geometry, transform: Transform::default(), material: None, animation: Playback::default() }
}

fn snapshot(scene: Scene) -> SceneMessage {
    SceneMessage::Snapshot { at_us: 7, scene }
}

#[test]
fn deltas_apply_in_order_and_a_gap_changes_nothing() {
    let mut scene = Scene { objects: vec![object(1), object(5)], ..Scene::default() };
    let moved = Transform { position: Vec3::X, ..Transform::default() };
    let delta = |revision, changes| SceneMessage::Delta { revision, at_us: 0, changes };
    scene.apply(&delta(1, vec![Change::Put(object(3)), Change::Move(ObjectId(5), moved), Change::Remove(ObjectId(1))])).unwrap();
    assert_eq!(scene.objects.iter().map(|o| o.id.0).collect::<Vec<_>>(), [3, 5]);
    assert_eq!(scene.objects[1].transform.position, Vec3::X);
    let before = scene.clone();
    assert_eq!(scene.apply(&delta(3, vec![])), Err(ApplyError::Gap { have: 1, got: 3 }));
    assert_eq!(
        scene.apply(&delta(2, vec![Change::Remove(ObjectId(3)), Change::Remove(ObjectId(9))])),
        Err(ApplyError::NoSuchObject(ObjectId(9)))
    );
    assert_eq!(scene, before);
}

#[test]
fn nothing_follows_the_last_revision() {
    let mut scene = Scene::default();
    scene.apply(&snapshot(Scene { revision: u64::MAX, ..Scene::default() })).unwrap();
    let delta = SceneMessage::Delta { revision: 0, at_us: 0, changes: vec![] };
    assert_eq!(scene.apply(&delta), Err(ApplyError::Gap { have: u64::MAX, got: 0 }));
}

#[test]
fn every_range_is_guarded() {
    let broken = |break_it: fn(&mut Object)| {
        let mut o = object(1);
        o.material = Some(Material::default());
        break_it(&mut o);
        snapshot(Scene { objects: vec![o], ..Scene::default() }).to_wire().unwrap_err().to_string()
    };
    assert!(broken(|o| o.id = ObjectId(FIRST_LOCAL_ID)).contains("id is out of range"));
    assert!(broken(|o| o.transform.position.x = f32::NAN).contains("position"));
    assert!(broken(|o| o.transform.rotation = Quat::from_xyzw(1.0, 1.0, 0.0, 0.0)).contains("rotation"));
    assert!(broken(|o| o.transform.scale.z = 0.0).contains("scale"));
    assert!(broken(|o| o.material = Some(Material { roughness: 1.5, ..Material::default() })).contains("roughness"));
    assert!(broken(|o| o.material = Some(Material { metallic: -0.1, ..Material::default() })).contains("metallic"));
    assert!(broken(|o| o.material = Some(Material { base_color: [f32::INFINITY; 3], ..Material::default() })).contains("base_color"));
    assert!(broken(|o| o.animation = Playback::Named(String::new())).contains("animation"));
    assert!(broken(|o| o.animation = Playback::Named("ä".repeat(MAX_ANIMATION_BYTES / 2 + 1))).contains("animation"));
}

#[test]
fn the_place_is_bounded_and_its_models_are_assets() {
    let mesh =
        |name: &[u8]| PlaceMesh { model: AssetId::of(name), transform: Transform::default(), casts_shadows: true, gloss: Gloss::MATT };
    let scene = Scene { place: vec![mesh(b"room"), mesh(b"table"), mesh(b"room")], ..Scene::default() };
    assert_eq!(scene.assets().len(), 2);
    let wire = snapshot(scene.clone()).to_wire().unwrap();
    assert_eq!(SceneMessage::from_wire(&wire).unwrap(), snapshot(scene.clone()));
    let refused = |place| snapshot(Scene { place, ..scene.clone() }).to_wire().unwrap_err().to_string();
    assert!(refused(vec![mesh(b"room"); MAX_PLACE_MESHES + 1]).contains("place"));
    let far = Transform { position: Vec3::splat(f32::INFINITY), ..Transform::default() };
    assert!(refused(vec![PlaceMesh { transform: far, ..mesh(b"room") }]).contains("position"));
    let rough = Gloss { roughness: 1.1, ..Gloss::MATT };
    let bright = Gloss { reflectance: f32::NAN, ..Gloss::MATT };
    assert!(refused(vec![PlaceMesh { gloss: rough, ..mesh(b"room") }]).contains("roughness"));
    let ground = |ground| snapshot(Scene { ground, ..Scene::default() }).to_wire().unwrap_err().to_string();
    assert!(ground(rough).contains("roughness") && ground(bright).contains("reflectance"));
}

#[test]
fn the_library_is_bounded_and_its_models_are_assets() {
    let item = LibraryItem { geometry: Geometry::Model(AssetId::of(b"chair")), material: None, ..LibraryItem::shapes()[0].clone() };
    let scene = |library| Scene { library, ..Scene::default() };
    assert_eq!(scene(vec![item.clone()]).assets(), [AssetId::of(b"chair")]);
    let refused = |item, count| snapshot(scene(vec![item; count])).to_wire().unwrap_err().to_string();
    assert!(refused(item.clone(), MAX_LIBRARY + 1).contains("library"));
    assert!(refused(LibraryItem { name: String::new(), ..item.clone() }, 1).contains("name"));
    assert!(refused(LibraryItem { scale: Vec3::new(1.0, f32::NAN, 1.0), ..item.clone() }, 1).contains("scale"));
    let glowing = Material { base_color: [2.0; 3], ..Material::default() };
    assert!(refused(LibraryItem { material: Some(glowing), ..item }, 1).contains("base_color"));
    scene(LibraryItem::shapes()).validate("scene").unwrap();
}

#[test]
fn a_full_scene_fits_a_message() {
    let objects = (0..MAX_OBJECTS as u32).map(|id| Object {
        geometry: Geometry::Model(AssetId::of(&id.to_le_bytes())),
        material: Some(Material::default()),
        animation: Playback::Named("a".repeat(MAX_ANIMATION_BYTES)),
        ..object(id)
    });
    let mesh = PlaceMesh { model: AssetId::of(b"room"), transform: Transform::default(), casts_shadows: true, gloss: Gloss::MATT };
    let place = vec![mesh; MAX_PLACE_MESHES];
    let item = LibraryItem { name: "ä".repeat(MAX_NAME_CHARS), ..LibraryItem::shapes()[0].clone() };
    let library = vec![item; MAX_LIBRARY];
    let scene = snapshot(Scene { objects: objects.collect(), place, library, ..Scene::default() });
    let wire = scene.to_wire().unwrap();
    assert_eq!(SceneMessage::from_wire(&wire).unwrap(), scene);
}

proptest! {
    #[test]
    fn random_bytes_never_panic(mut bytes in proptest::collection::vec(any::<u8>(), 1..400)) {
        bytes[0] = SceneMessage::VERSION;
        let _ = SceneMessage::from_wire(&bytes);
    }
}
