//! Scene files as written, and every fault named.

use super::*;

fn parse(text: &str) -> Result<SceneFile, SceneFileError> {
    SceneFile::parse(text, Path::new("stage/SCENE.toml"))
}

#[test]
fn a_scene_reads_as_written() {
    let file = parse(
        r#"
        ground_y = -1.5
        [[object]]
        shape = "sphere"
        position = [1.0, 2.0, 3.0]
        scale = [1.0, 2.0, 1.0]
        material = { base_color = [1.0, 0.5, 0.0], roughness = 0.1, metallic = 1.0 }
        [[object]]
        model = "fox.glb"
        rotation_deg = [0.0, 90.0, 0.0]
        [[object]]
        model = "fox.glb"
        animation = "Walk"
        [[object]]
        model = "fox.glb"
        animation = "none"
        "#,
    )
    .unwrap();
    assert_eq!(file.models(), [Path::new("stage/fox.glb")]);
    let fox = AssetId::of(b"fox");
    let scene = file.resolve(|_| Ok::<_, String>(fox)).unwrap();
    assert_eq!(scene.ground_y, -1.5);
    assert_eq!(scene.objects[0].transform.scale, Vec3::new(1.0, 2.0, 1.0));
    assert_eq!(scene.objects[0].material.unwrap().metallic, 1.0);
    assert_eq!(scene.objects[1].geometry, Geometry::Model(fox));
    assert_eq!(scene.objects[1].material, None);
    let animations: Vec<_> = scene.objects.iter().map(|object| object.animation.clone()).collect();
    assert_eq!(animations, [Playback::First, Playback::First, Playback::Named("Walk".to_owned()), Playback::Still]);
    // A quarter turn about +y takes −z to −x.
    assert!((scene.objects[1].transform.rotation * -Vec3::Z - -Vec3::X).length() < 1e-6);
}

#[test]
fn glass_is_clear_and_all_else_matt_unless_the_file_says_otherwise() {
    let roughness = |material: &str| {
        let file = parse(&format!("ground_y = 0.0\n[[object]]\nshape = \"cube\"\nmaterial = {{ {material} }}")).unwrap();
        file.resolve(|_| Err::<AssetId, String>("no models".to_owned())).unwrap().objects[0].material.unwrap().roughness
    };
    assert_eq!(roughness("kind = \"glass\""), 0.0);
    assert_eq!(roughness("kind = \"glass\", roughness = 0.4"), 0.4);
    assert_eq!(roughness("metallic = 0.5"), Material::default().roughness);
}

#[test]
fn each_wrong_field_is_named() {
    let sphere = "ground_y = 0.0\n[[object]]\nshape = \"sphere\"\n";
    for (text, names) in [
        (String::new(), "ground_y"),
        ("ground_y = \"low\"".to_owned(), "ground_y"),
        ("ground_y = nan".to_owned(), "ground_y"),
        ("ground_y = 0.0\nsky = 1".to_owned(), "sky"),
        ("ground_y = 0.0\n[[object]]".to_owned(), "neither shape nor model"),
        (format!("{sphere}model = \"a.glb\""), "both shape and model"),
        ("ground_y = 0.0\n[[object]]\nshape = \"torus\"".to_owned(), "torus"),
        (format!("{sphere}position = [1.0]"), "position"),
        (format!("{sphere}position = [inf, 0.0, 0.0]"), "position"),
        (format!("{sphere}rotation_deg = [nan, 0.0, 0.0]"), "rotation_deg"),
        (format!("{sphere}scale = 0.0"), "scale"),
        (format!("{sphere}scale = \"big\""), "scale"),
        (format!("{sphere}material = {{ roughness = 2.0 }}"), "roughness"),
        (format!("{sphere}material = {{ metallic = -1.0 }}"), "metallic"),
        (format!("{sphere}material = {{ base_color = [2.0, 0.0, 0.0] }}"), "base_color"),
        (format!("{sphere}material = {{ kind = \"wood\" }}"), "wood"),
        (format!("{sphere}material = {{ shiny = true }}"), "shiny"),
        (format!("{sphere}colour = 1"), "colour"),
        (format!("{sphere}animation = \"Walk\""), "shapes have none"),
        ("ground_y = 0.0\n[[object]]\nmodel = \"a.glb\"\nanimation = \"\"".to_owned(), "animation"),
    ] {
        let error = parse(&text).unwrap_err().to_string();
        assert!(error.contains(names) && error.contains("stage/SCENE.toml"), "{text:?} gave {error}");
    }
}

#[test]
fn a_model_of_many_objects_is_read_once() {
    let file = parse(&format!("ground_y = 0.0\n{}", "[[object]]\nmodel = \"fox.glb\"\n".repeat(3))).unwrap();
    let mut reads = 0;
    let scene = file.resolve(|_| {
        reads += 1;
        Ok::<_, String>(AssetId::of(b"fox"))
    });
    assert_eq!((scene.unwrap().objects.len(), reads), (3, 1));
}

#[test]
fn the_place_reads_as_written_and_its_faults_are_named() {
    let file = parse(
        "ground_y = 0.0\n[[place]]\nmodel = \"room.glb\"\nposition = [1.0, 0.0, 0.0]\n[[place]]\nmodel = \"lamp.glb\"\ncasts_shadows = false",
    );
    let file = file.unwrap();
    assert_eq!(file.models(), [Path::new("stage/lamp.glb"), Path::new("stage/room.glb")]);
    let scene = file.resolve(|path| Ok::<_, String>(AssetId::of(path.as_os_str().as_encoded_bytes()))).unwrap();
    assert_eq!((scene.ground, scene.place[0].gloss), (Gloss::MATT, Gloss::MATT));
    assert_eq!((scene.place[0].transform.position, scene.place[0].casts_shadows, scene.place[1].casts_shadows), (Vec3::X, true, false));
    let error = file.resolve(|_| Err::<AssetId, _>("no such file")).unwrap_err().to_string();
    assert!(error.contains("place 1") && error.contains("stage/room.glb"), "{error}");
    let mesh = "ground_y = 0.0\n[[place]]\nmodel = \"room.glb\"\n";
    for (text, names) in [
        ("ground_y = 0.0\n[[place]]".to_owned(), "model"),
        (format!("{mesh}roughness = 1.0"), "roughness"),
        (format!("{mesh}gloss = {{ roughness = 2.0 }}"), "roughness"),
        (format!("{mesh}gloss = {{ reflectance = 0.1 }}"), "roughness"),
        ("ground_y = 0.0\nground = { roughness = 0.1, reflectance = -1.0 }".to_owned(), "reflectance"),
        ("ground_y = 0.0\nground = { roughness = 0.1, shine = 1.0 }".to_owned(), "shine"),
        (format!("{mesh}scale = -1.0"), "scale"),
        (format!("{mesh}rotation_deg = [nan, 0.0, 0.0]"), "rotation_deg"),
        (format!("ground_y = 0.0\n{}", "[[place]]\nmodel = \"room.glb\"\n".repeat(17)), "17 place meshes"),
    ] {
        let error = parse(&text).unwrap_err().to_string();
        assert!(error.contains(names) && error.contains("stage/SCENE.toml"), "{text:?} gave {error}");
    }
}

#[test]
fn what_mirrors_reads_as_written() {
    let file = parse(
        "ground_y = 0.0\nground = { roughness = 0.25 }\n[[place]]\nmodel = \"a.glb\"\ngloss = { roughness = 0.5, reflectance = 0.1 }",
    );
    let scene = file.unwrap().resolve(|_| Ok::<_, String>(AssetId::of(b"a"))).unwrap();
    assert_eq!(scene.ground, Gloss { roughness: 0.25, reflectance: Gloss::DIELECTRIC });
    assert_eq!(scene.place[0].gloss, Gloss { roughness: 0.5, reflectance: 0.1 });
}

#[test]
fn physics_is_dynamic_unless_the_file_says_otherwise() {
    let file = parse(
        "ground_y = 0.0\n[[object]]\nshape = \"cube\"\n[[object]]\nshape = \"cube\"\nphysics = \"fixed\"\n\
         [[library]]\nname = \"a\"\nshape = \"cube\"\nphysics = \"dynamic\"\n[[library]]\nname = \"b\"\nshape = \"cube\"\nphysics = \"fixed\"",
    );
    let file = file.unwrap();
    assert_eq!(file.fixed_objects(), BTreeSet::from([ObjectId(2)]));
    assert_eq!(file.fixed_items(), BTreeSet::from([1]));
}

#[test]
fn the_library_reads_as_written_and_its_faults_are_named() {
    let asset = |path: &Path| Ok::<_, String>(AssetId::of(path.as_os_str().as_encoded_bytes()));
    let library = |text: &str| parse(&format!("ground_y = 0.0\n{text}")).unwrap().resolve(asset).unwrap().library;
    assert_eq!(library(""), LibraryItem::shapes());
    assert_eq!(library("library = []"), []);
    let [chair, ball] = &library(
        "[[library]]\nname = \"chair\"\nmodel = \"chair.glb\"\nscale = 0.5\n[[library]]\nname = \"ball\"\nshape = \"sphere\"\nmaterial = { roughness = 0.25 }",
    )[..] else {
        panic!("two items");
    };
    assert_eq!(
        (chair.name.as_str(), chair.geometry, chair.scale),
        ("chair", Geometry::Model(asset(Path::new("stage/chair.glb")).unwrap()), Vec3::splat(0.5))
    );
    assert_eq!((chair.material, ball.material.unwrap().roughness), (None, 0.25));
    let item = "ground_y = 0.0\n[[library]]\nshape = \"cube\"\n";
    for (text, names) in [
        (item.to_owned(), "name"),
        (format!("{item}name = \"\""), "name"),
        (format!("{item}name = \"a\"\nmodel = \"a.glb\""), "both shape and model"),
        (format!("{item}name = \"a\"\nscale = -1.0"), "scale"),
        (format!("{item}name = \"a\"\nphysics = \"soft\""), "soft"),
        (format!("{item}name = \"a\"\nposition = [0.0, 0.0, 0.0]"), "position"),
        (format!("ground_y = 0.0\n{}", "[[library]]\nname = \"a\"\nshape = \"cube\"\n".repeat(65)), "65 items"),
    ] {
        let error = parse(&text).unwrap_err().to_string();
        assert!(error.contains(names) && error.contains("stage/SCENE.toml"), "{text:?} gave {error}");
    }
    let file = parse("ground_y = 0.0\n[[library]]\nname = \"chair\"\nmodel = \"chair.glb\"").unwrap();
    let error = file.resolve(|_| Err::<AssetId, _>("no such file")).unwrap_err().to_string();
    assert!(error.contains("library 1") && error.contains("stage/chair.glb"), "{error}");
}

#[test]
fn a_missing_model_names_file_and_object() {
    let file = parse("ground_y = 0.0\n[[object]]\nmodel = \"no.glb\"").unwrap();
    let error = file.resolve(|_| Err::<AssetId, _>("no such file")).unwrap_err().to_string();
    assert!(error.contains("object 1") && error.contains("stage/no.glb") && error.contains("no such file"), "{error}");
    assert!(matches!(SceneFile::load(Path::new("/nowhere/SCENE.toml")), Err(SceneFileError::Read { .. })));
}
