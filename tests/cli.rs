//! The command as a user meets it: what it prints, what it writes, how it ends.

use occlude_host::reproduce::theory::FILES;
use std::path::Path;
use std::process::{Command, Output};

fn scene(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes").join(name).display().to_string()
}

const PROGRAM: &str = env!("CARGO_BIN_EXE_occlude");

fn occlude(args: &[&str], folder: &Path) -> Output {
    Command::new(PROGRAM).args(args).current_dir(folder).output().expect("it starts")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn renders_writes_and_reports() {
    let folder = tempfile::tempdir().expect("a folder");
    let args = [
        "render",
        &scene("cornell"),
        "-o",
        "a.png",
        "-o",
        "a.exr",
        "-o",
        "a.pfm",
        "-o",
        "a.hdr",
        "--size",
        "40x30",
        "--spp",
        "3",
        "--shadow-rays",
        "8",
        "--stats",
        "s.json",
        "--threads",
        "2",
    ];
    let done = occlude(&args, folder.path());
    assert_eq!(done.status.code(), Some(0), "{}", text(&done.stderr));
    assert!(done.stdout.is_empty(), "{}", text(&done.stdout));
    // In a pipe a line a second, and the last.
    let said = text(&done.stderr);
    assert!(said.contains("pass 3 of 3, "), "{said}");
    for file in ["a.png", "a.exr", "a.pfm", "a.hdr"] {
        assert!(folder.path().join(file).metadata().expect(file).len() > 100);
    }
    let json = std::fs::read_to_string(folder.path().join("s.json")).expect("statistics");
    let stats: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    assert_eq!(stats["counts"]["camera_rays"], 40 * 30 * 3);
    assert!(stats["counts"]["shadow_rays"].as_u64() > Some(1000));
    for key in
        ["load_s", "build_s", "preprocess_s", "render_s", "camera_s", "light_s", "visibility_s", "shade_s"]
    {
        assert!(stats["time"][key].is_number(), "{key}");
    }
    assert!(stats["memory"]["bvh_bytes"].as_u64() > Some(0));

    let compared = occlude(&["compare", "a.exr", "a.pfm"], folder.path());
    assert_eq!(compared.status.code(), Some(0), "{}", text(&compared.stderr));
    assert!(text(&compared.stdout).contains("RMSE"), "{}", text(&compared.stdout));
}

/// Estimates may be negative: pictures are written all the same, floats as they are and colours clamped.
#[test]
fn stochastic_renders_are_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let args = [
        "render",
        &scene("plates"),
        "--size",
        "48x32",
        "--spp",
        "1",
        "--shadow-rays",
        "4",
        "--method",
        "stochastic",
        "--decomposition",
        "inclusion",
        "--probabilities",
        "optimal",
        "--split",
        "sorted",
        "--quotas",
        "-o",
        "a.png",
        "-o",
        "a.exr",
        "-o",
        "a.hdr",
        "-o",
        "a.pfm",
        "--stats",
        "s.json",
    ];
    let done = occlude(&args, folder.path());
    assert_eq!(done.status.code(), Some(0), "{}", text(&done.stderr));
    let json = std::fs::read_to_string(folder.path().join("s.json")).expect("statistics");
    let stats: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    assert_eq!(stats["method"], "stochastic inclusion optimal sorted quotas");
    assert!(stats["counts"]["triangle_tests"].as_u64() > Some(1000));
    for (name, negative) in [("a.exr", true), ("a.pfm", true), ("a.hdr", false), ("a.png", false)] {
        let compared = occlude(&["compare", "--json", name, "a.exr"], folder.path());
        assert_eq!(compared.status.code(), Some(0), "{}", text(&compared.stderr));
        let found: serde_json::Value = serde_json::from_str(&text(&compared.stdout)).expect("JSON");
        assert_eq!((&found["nan"], &found["infinite"]), (&0.into(), &0.into()), "{name}");
        assert_eq!(found["negative"].as_u64() > Some(0), negative, "{name}");
    }
}

#[test]
fn boxes_in_columns_change_no_bit() {
    let folder = tempfile::tempdir().expect("a folder");
    let columns = scene("columns");
    let render = |switch: &str| {
        let (image, stats) = (format!("{switch}.pfm"), format!("{switch}.json"));
        let args = [
            "render",
            &columns,
            "--size",
            "96x54",
            "--spp",
            "1",
            "--method",
            "exact",
            "--volumetric",
            switch,
        ];
        let done = occlude(&[&args[..], &["-o", &image, "--stats", &stats]].concat(), folder.path());
        assert_eq!(done.status.code(), Some(0), "{}", text(&done.stderr));
        let json = std::fs::read_to_string(folder.path().join(stats)).expect("statistics");
        let stats: serde_json::Value = serde_json::from_str(&json).expect("JSON");
        (std::fs::read(folder.path().join(image)).expect("an image"), stats)
    };
    let ((with, with_stats), (without, without_stats)) = (render("on"), render("off"));
    assert!(with == without);
    assert_eq!(with_stats["volumes"]["boxes"], 25);
    assert!(with_stats["volumes"]["fraction"].as_f64() > Some(0.9));
    assert!(without_stats["volumes"].is_null());
}

#[test]
fn a_pipe_hears_of_passes_once_a_second() {
    let folder = tempfile::tempdir().expect("a folder");
    let args =
        ["render", &scene("plates"), "-o", "a.pfm", "--size", "4x4", "--spp", "400", "--method", "exact"];
    let start = std::time::Instant::now();
    let done = occlude(&args, folder.path());
    let seconds = start.elapsed().as_secs_f64();
    let said = text(&done.stderr);
    let lines = said.lines().filter(|line| line.starts_with("pass ")).count();
    assert!(said.contains("pass 400 of 400, ") && lines as f64 <= seconds + 1.0, "{seconds} s: {said}");
}

#[test]
fn quiet_is_quiet() {
    let folder = tempfile::tempdir().expect("a folder");
    let args = ["render", &scene("plates"), "-o", "a.png", "--size", "8x8", "--spp", "1", "--quiet"];
    let done = occlude(&args, folder.path());
    assert_eq!(done.status.code(), Some(0));
    assert!(done.stdout.is_empty() && done.stderr.is_empty(), "{}", text(&done.stderr));
}

#[test]
fn errors_end_with_two_and_name_the_cause() {
    let folder = tempfile::tempdir().expect("a folder");
    let (cornell, half_plane) = (scene("cornell"), scene("half_plane"));
    let file = &format!("{cornell}/scene.obj");
    let cases: &[(&[&str], &str)] = &[
        (&["render", &cornell, "-o", "a.jpg"], "png"),
        (&["render", &cornell, "-o", "missing/a.png"], "missing"),
        (&["render", &cornell, "--spp", "0"], "spp"),
        (&["render", &cornell, "--size", "12"], "1280x720"),
        (&["render", &cornell, "--size", "0x9"], "size"),
        (&["render", &cornell, "--vfov", "180"], "vfov"),
        (&["render", &cornell, "--eye", "1,2"], "three numbers"),
        (&["render", &cornell, "--split", "sorted"], "--split is an option of --method stochastic"),
        (
            &["render", &cornell, "--method", "stochastic", "--volumetric", "on"],
            "--volumetric is an option of --method exact and map",
        ),
        (&["render", &cornell, "--quotas"], "--quotas is an option of --method stochastic"),
        (&["render", &cornell, "--method", "stochastic", "--levels", "3"], "--decomposition residual"),
        (&["render", &cornell, "--method", "stochastic", "--levels", "1"], "--levels"),
        (&["render", &cornell, "--method", "stochastic", "--decomposition", "power:1"], "from 2 to 64"),
        (&["render", &cornell, "--method", "stochastic", "--decomposition", "product"], "power:N"),
        (
            &[
                "render",
                &half_plane,
                "--method",
                "stochastic",
                "--decomposition",
                "residual",
                "--probabilities",
                "importance",
            ],
            "residual takes uniform or optimal",
        ),
        (
            &[
                "render",
                &half_plane,
                "--method",
                "stochastic",
                "--decomposition",
                "residual",
                "--split",
                "object",
                "--levels",
                "9",
            ],
            "at least 9 objects",
        ),
        (&["--simd", "mmx", "info"], "this CPU has"),
        (&["compare", "a.exr", "b.exr"], "a.exr"),
        (&["generate", "marble"], "marble"),
        (&["reproduce", "magic"], "magic"),
        (&["reproduce", "theory", "-o", &cornell], "--force"),
        (&["reproduce", "map", "-o", &cornell], "--force"),
        (&["info", "--size", "3x3"], "--size is for a scene"),
        (&["photons", &cornell, "-o", "p.ply", "--show", "classes"], "--show is for images"),
        (&["reproduce", "map", "--quick", "--scenes", &cornell], "no folder columns or fence"),
        (&["compare-methods", &cornell, "--reference-rays", "1e6"], "65536"),
        (&["render", &cornell, "--photons", "9"], "--blockers map"),
        (&["render", &cornell, "--photon-rounds", "3"], "--blockers map"),
        (&["render", &cornell, "--method", "map", "--photon-rounds", "0"], "--photon-rounds"),
        (
            &["render", &cornell, "--method", "map", "--blocker-trees", "--blocker-kind", "object"],
            "--blocker-kind triangle",
        ),
        (&["render", &cornell, "--blocker-trees"], "--blockers map"),
        (&["render", &cornell, "--method", "map", "--test-rays", "cell"], "--method stochastic"),
        (&["render", &cornell, "--method", "stochastic", "--test-rays", "point"], "importance or optimal"),
        (
            &[
                "render",
                &cornell,
                "--method",
                "stochastic",
                "--probabilities",
                "optimal",
                "--test-rays",
                "cell",
            ],
            "--blockers map",
        ),
        (&["render", &half_plane, "--method", "stochastic", "--split", "treelet"], "--blockers map"),
        (
            &[
                "render",
                &cornell,
                "--method",
                "stochastic",
                "--blockers",
                "map",
                "--split",
                "treelet",
                "--blocker-trees",
            ],
            "--split sorted",
        ),
        (&["render", &cornell, "--blockers", "map"], "--method stochastic"),
        (&["render", &cornell, "--method", "stochastic", "--photon-k", "9"], "--blockers map"),
        (
            &["render", &cornell, "--method", "stochastic", "--blockers", "triangle"],
            "--blocker-kind triangle",
        ),
        (&["render", &cornell, "--method", "map", "--blockers", "all"], "--blocker-kind"),
        (&["render", &cornell, "--method", "map", "--blockers", "house"], "treelet:SIZE"),
        (&["render", &cornell, "--method", "map", "--blocker-kind", "treelet:1"], "treelet:128"),
        (
            &["render", &cornell, "--method", "map", "--blockers", "object", "--blocker-kind", "object"],
            "--blocker-kind alone",
        ),
        (
            &["render", &cornell, "--method", "stochastic", "--blockers", "map", "--split", "object"],
            "random or sorted",
        ),
        (&["reproduce", "theory", "--threads", "99999999"], "threads"),
        (&["reproduce", "theory", "--threads", "9999"], "1024"),
        (&["compare-methods", &cornell, "--methods", "magic"], "magic"),
        (&["compare-methods", &cornell, "--methods", "auto,exact,auto"], "twice"),
        (&["compare-methods", &cornell, "-o", &cornell], "--force"),
        (&["compare-methods", "nowhere"], "nowhere"),
        (&["render", &cornell, "--adaptive", "perhaps"], "perhaps"),
        (&["render", &cornell, "--method", "auto", "--volumetric", "on"], "--volumetric"),
        (&["render", &cornell, "--vfov", "-10"], "--vfov is -10"),
        (&["render", &cornell, "--time-limit", "-1"], "must be a time from 0 on"),
        (&["render", &cornell, "--spp", "-1"], "a whole number from 1 to"),
        (&["render", &cornell, "--spp", "1.5"], "a whole number from 1 to"),
        (&["render", &cornell, "--seed", "-1"], "a whole number from 0 to"),
        (&["render", &cornell, "--size", "-5x3"], "1280x720"),
        (&["render", &cornell, "--map-memory", "-64M"], "a number of bytes"),
        (&["render", &cornell, "--method", "map", "--photons", "-1e5"], "a whole number from 1 to"),
        (&["render", &cornell, "--method", "map", "--photon-radius", "-1"], "above 0"),
        (&["map", &cornell, "-o", "a.map", "--passes", "-1"], "a whole number from 1 to"),
        (&["photons", &cornell, "-o", "a.png", "--most", "-1"], "a whole number from 1 to"),
        (&["compare-methods", &cornell, "--reference-rays", "-1"], "a whole number from 1 to"),
        (&["reproduce", "theory", "--seed", "-1"], "a whole number from 0 to"),
        (&["generate", "hair", "-t", "-1"], "2M is needed"),
        (&["render", "nowhere"], "name a folder with a scene.obj"),
        (&["render", &cornell, "--map", "none.map"], "occlude map SCENE -o none.map"),
        (&["render", &cornell, "--camera", "none.json"], "the camera file none.json: there is no such file"),
        (&["render", &cornell, "--reference", "none.exr"], "the image none.exr: there is no such file"),
        (&["photons", &cornell, "-o", "a.xyz"], ".ply"),
        (&["photons", &cornell, "-o", "a.png", "--blocker-trees"], "--blocker-trees"),
        (&["generate", "hair", "-o", file], "a folder is wanted"),
        (&["generate", "hair", "-o", file, "--force"], "a folder is wanted"),
        (&["map", file, "--passes", "3"], "--output <FILE>"),
        (&["map", file, "--inspect", "--seed", "3"], "--seed"),
        (&["map", "none.map", "--size", "3x3"], "--size is for a scene"),
        (&["frobnicate"], "frobnicate"),
    ];
    for (args, cause) in cases {
        let done = occlude(args, folder.path());
        let said = text(&done.stderr);
        assert_eq!(done.status.code(), Some(2), "{args:?}: {said}");
        assert!(said.contains(cause), "{args:?}: {said}");
        assert!(!said.contains("panicked"), "{said}");
    }
    assert_eq!(
        std::fs::read_dir(folder.path()).expect("the folder").count(),
        0,
        "nothing may be left behind"
    );
}

/// A copy of a scene, which a test may spoil.
fn copied(name: &str, to: &Path) {
    std::fs::create_dir(to).expect("a folder");
    for file in ["scene.obj", "scene.mtl", "camera.json"] {
        std::fs::copy(Path::new(&scene(name)).join(file), to.join(file)).expect(file);
    }
}

#[test]
fn nothing_overwrites_what_is_read_or_written() {
    let folder = tempfile::tempdir().expect("a folder");
    copied("plates", &folder.path().join("cc"));
    let small = ["--size", "8x8", "-q"];
    for args in
        [&["render", "cc", "--spp", "1", "-o", "a.exr"][..], &["map", "cc", "--passes", "1", "-o", "m.map"]]
    {
        let done = occlude(&[args, &small].concat(), folder.path());
        assert_eq!(done.status.code(), Some(0), "{args:?}: {}", text(&done.stderr));
    }
    let files = ["cc/scene.obj", "cc/scene.mtl", "cc/camera.json", "a.exr", "m.map"];
    let read = || files.map(|file| std::fs::read(folder.path().join(file)).expect(file));
    let before = read();
    for (args, named) in [
        (
            &["render", "cc", "--stats", "cc/scene.obj"][..],
            ["--stats cc/scene.obj", "cc/scene.obj, which is read"],
        ),
        (
            &["render", "cc", "--stats", "cc/scene.mtl"],
            ["--stats cc/scene.mtl", "cc/scene.mtl, which is read"],
        ),
        (&["render", "cc", "--stats", "cc/camera.json"], ["--stats cc/camera.json", "which is read"]),
        (
            &["map", "cc", "-o", "cc/../cc/scene.obj"],
            ["--output cc/../cc/scene.obj", "the scene's cc/scene.obj"],
        ),
        (&["render", "cc", "--map", "m.map", "--stats", "m.map"], ["--stats m.map", "--map m.map"]),
        (&["render", "cc", "-o", "b.exr", "--stats", "./b.exr"], ["--stats ./b.exr", "--output b.exr"]),
        (&["render", "cc", "-o", "a.exr", "--reference", "a.exr"], ["--output a.exr", "--reference a.exr"]),
        (&["compare", "a.exr", "a.exr", "-o", "a.exr"], ["--output a.exr", "the image a.exr"]),
        (&["render", "cc", "--stats", "new/"], ["writing new/", "name a file"]),
        (&["map", "cc", "-o", "new/"], ["writing new/", "name a file"]),
        (&["photons", "cc", "-o", "p.ply/"], ["writing p.ply/", "name a file"]),
    ] {
        let scene = args[0] != "compare";
        let refused = occlude(&[args, if scene { &small[..2] } else { &[] }].concat(), folder.path());
        let said = text(&refused.stderr);
        assert_eq!(refused.status.code(), Some(2), "{args:?}: {said}");
        assert!(named.iter().all(|name| said.contains(name)), "{args:?}: {said}");
    }
    assert!(read() == before);
    // What was made before may be made again.
    for args in [
        &["map", "cc", "--passes", "1", "-o", "m.map"][..],
        &["render", "cc", "--spp", "1", "-o", "a.exr", "--stats", "/dev/null", "-o", "b.exr"],
    ] {
        let done = occlude(&[args, &small].concat(), folder.path());
        assert_eq!(done.status.code(), Some(0), "{args:?}: {}", text(&done.stderr));
    }
}

#[cfg(unix)]
#[test]
fn statistics_go_down_a_pipe() {
    let folder = tempfile::tempdir().expect("a folder");
    for to in ["/dev/stdout", "/dev/stderr"] {
        let args =
            ["render", &scene("plates"), "-o", "a.pfm", "--size", "8x8", "--spp", "1", "-q", "--stats", to];
        let done = occlude(&args, folder.path());
        assert_eq!(done.status.code(), Some(0), "{}", text(&done.stderr));
        let said = if to == "/dev/stdout" { done.stdout } else { done.stderr };
        let stats: serde_json::Value = serde_json::from_str(&text(&said)).expect("JSON");
        assert_eq!(stats["counts"]["camera_rays"], 64);
    }
}

/// Behind a stream may be a file, and in it what others wrote.
#[cfg(unix)]
#[test]
fn statistics_are_added_to_a_log() {
    let folder = tempfile::tempdir().expect("a folder");
    std::os::unix::fs::symlink("/dev/stdout", folder.path().join("link.json")).expect("a link");
    let log = folder.path().join("log.jsonl");
    let of_ours = std::fs::File::create(&log).expect("a log");
    let own = format!("/proc/{}/fd/{}", std::process::id(), std::os::fd::AsRawFd::as_raw_fd(&of_ours));
    let others = if Path::new(&own).exists() { &[own.as_str(), "/proc/self/fd/1"][..] } else { &[] };
    for to in [&["/dev/stdout", "link.json", "/dev/stderr", "/dev/fd/1"], others].concat() {
        std::fs::write(&log, "before\n").expect("a log");
        for _ in 0..2 {
            let open = || std::fs::OpenOptions::new().append(true).open(&log).expect("the log");
            let args = [
                "render",
                &scene("plates"),
                "-o",
                "a.pfm",
                "--size",
                "8x8",
                "--spp",
                "1",
                "-q",
                "--stats",
                to,
            ];
            let done = Command::new(PROGRAM)
                .args(args)
                .current_dir(folder.path())
                .stdout(open())
                .stderr(open())
                .status()
                .expect("it starts");
            assert_eq!(done.code(), Some(0), "{to}");
        }
        let said = std::fs::read_to_string(&log).expect("the log");
        let rest = said.strip_prefix("before\n").unwrap_or_else(|| panic!("{to}: {said}"));
        let records = serde_json::Deserializer::from_str(rest).into_iter::<serde_json::Value>();
        let rays: Vec<_> =
            records.map(|stats| stats.expect("JSON")["counts"]["camera_rays"].clone()).collect();
        assert_eq!(rays, [64, 64], "{to}");
        assert!(folder.path().join("link.json").is_symlink());
        assert_eq!(std::fs::read_dir(folder.path()).expect("the folder").count(), 3, "{to}");
    }
}

#[cfg(unix)]
#[test]
fn streams_are_checked_before_anything_is_rendered() {
    let folder = tempfile::tempdir().expect("a folder");
    let plates = scene("plates");
    copied("plates", &folder.path().join("plates"));
    let file = folder.path().join("plates/scene.obj");
    let before = std::fs::read(&file).expect("the scene");
    for (scene, to, said) in [
        (&plates, "/dev/fd/99", "writing /dev/fd/99"),
        (&plates, "/dev/fd/x.json", "writing /dev/fd/x.json"),
        (&"plates".to_owned(), "/dev/stdout", "which is read"),
    ] {
        let stdout = std::fs::OpenOptions::new().append(true).open(&file).expect("the scene");
        let args = ["render", scene, "-o", "a.pfm", "--size", "8x8", "--spp", "1", "--stats", to];
        let run = Command::new(PROGRAM).args(args).current_dir(folder.path()).stdout(stdout).output();
        let done = run.expect("it starts");
        assert_eq!(done.status.code(), Some(2), "{to}");
        assert!(text(&done.stderr).contains(said), "{to}: {}", text(&done.stderr));
        assert!(!folder.path().join("a.pfm").exists());
    }
    assert_eq!(std::fs::read(&file).expect("the scene"), before);
}

#[test]
fn references_are_looked_at_before_anything_is_rendered() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut reference = b"PF\n2 1\n-1.0\n".to_vec();
    reference.extend([1.0f32, 1.0, f32::NAN, 1.0, 1.0, 1.0].iter().flat_map(|v| v.to_le_bytes()));
    std::fs::write(folder.path().join("r.pfm"), reference).expect("a reference");
    let args = ["render", &scene("plates"), "-o", "a.pfm", "--size", "2x1", "--reference", "r.pfm"];
    let done = occlude(&args, folder.path());
    let said = text(&done.stderr);
    assert_eq!(done.status.code(), Some(2), "{said}");
    assert!(said.contains("r.pfm") && said.contains("1 pixels that are not finite"), "{said}");
    assert!(!folder.path().join("a.pfm").exists());
    let compared = occlude(&["compare", "r.pfm", "r.pfm"], folder.path());
    let said = text(&compared.stderr);
    assert_eq!(compared.status.code(), Some(2), "{said}");
    assert!(said.contains("r.pfm: held against r.pfm"), "{said}");
}

#[test]
fn a_target_before_the_scene_is_looked_at_from_somewhere() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::copy(Path::new(&scene("plates")).join("scene.obj"), folder.path().join("scene.obj"))
        .expect("a scene");
    std::fs::copy(Path::new(&scene("plates")).join("scene.mtl"), folder.path().join("scene.mtl"))
        .expect("colours");
    for target in ["600,450,1000", "6e7,4.5e7,1e8"] {
        let args = ["render", "scene.obj", "-o", "a.pfm", "--size", "4x4", "--spp", "1", "--target", target];
        let done = occlude(&args, folder.path());
        assert_eq!(done.status.code(), Some(0), "{}", text(&done.stderr));
    }
}

#[test]
fn what_is_generated_renders() {
    let folder = tempfile::tempdir().expect("a folder");
    let made = occlude(&["generate", "spheres", "--triangles", "5k", "-o", "s"], folder.path());
    assert_eq!(made.status.code(), Some(0), "{}", text(&made.stderr));
    let again = occlude(&["generate", "spheres", "--triangles", "5k", "-o", "s"], folder.path());
    assert_eq!(again.status.code(), Some(2), "a folder in use is left alone");
    let info = occlude(&["info", "s"], folder.path());
    assert!(text(&info.stdout).contains("closed"), "{}", text(&info.stdout));
    let done = occlude(&["render", "s", "--size", "32x20", "--spp", "1", "-o", "s.png"], folder.path());
    assert_eq!(done.status.code(), Some(0), "{}", text(&done.stderr));
}

/// Runs the program, presses Ctrl-C after a while, and gives what it says then.
#[cfg(unix)]
fn interrupted(args: &[&str], folder: &Path) -> String {
    let child = Command::new(PROGRAM)
        .args(args)
        .current_dir(folder)
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("it starts");
    std::thread::sleep(std::time::Duration::from_millis(1500));
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill");
    assert!(killed.success());
    let done = child.wait_with_output().expect("it ends");
    let said = text(&done.stderr);
    assert_eq!(done.status.code(), Some(1), "{said}");
    said
}

#[cfg(unix)]
#[test]
fn interrupting_keeps_what_there_is() {
    let folder = tempfile::tempdir().expect("a folder");
    let columns = scene("columns");
    let args = ["render", &columns, "-o", "a.png", "--spp", "100000", "--size", "96x54"];
    let said = interrupted(&args, folder.path());
    assert!(said.contains("interrupted after"), "{said}");
    assert!(folder.path().join("a.png").exists());
}

#[cfg(unix)]
#[test]
fn interrupting_the_writing_of_a_scene_leaves_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let args = ["generate", "spheres", "--triangles", "10M", "-o", "very/big"];
    let mut child = Command::new(PROGRAM).args(args).current_dir(folder.path()).spawn().expect("it starts");
    let big = folder.path().join("very/big");
    while !big.exists() {
        assert!(child.try_wait().expect("its state").is_none(), "it ended before it wrote");
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill");
    assert!(killed.success());
    let status = child.wait().expect("it ends");
    assert_eq!(status.code(), Some(1));
    assert_eq!(std::fs::read_dir(folder.path()).expect("the folder").count(), 0);
}

/// What an earlier run wrote is better than nothing.
#[cfg(unix)]
#[test]
fn interrupting_the_first_pass_writes_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("kept"), "good").expect("a file");
    std::os::unix::fs::symlink("kept", folder.path().join("a.exr")).expect("a link");
    let columns = scene("columns");
    for args in [
        &["render", &columns, "--method", "exact", "-o", "a.exr", "--stats", "s.json", "--spp", "9"][..],
        &["map", &columns, "-o", "kept"],
    ] {
        // So many that no pass ends in time, and tiles of 256 pixels do.
        let long = ["--size", "1600x900", "--shadow-rays", "256", "--threads", "1"];
        let said = interrupted(&[args, &long].concat(), folder.path());
        assert!(said.contains("nothing was written"), "{said}");
        assert_eq!(std::fs::read(folder.path().join("kept")).expect("the file"), b"good");
        assert_eq!(std::fs::read_dir(folder.path()).expect("the folder").count(), 2);
    }
}

/// Is a word anywhere in a page, but in the letters that pictures are written in?
fn says(page: &roxmltree::Document<'_>, word: &str) -> bool {
    page.descendants().any(|node| {
        let texts = node.text().into_iter().chain(node.attributes().map(|attribute| attribute.value()));
        texts.filter(|text| !text.starts_with("data:")).any(|text| text.contains(word))
    })
}

/// Rows of a file of data as maps from the names of its columns.
fn rows(file: &Path) -> Vec<std::collections::HashMap<String, String>> {
    let mut reader = csv::Reader::from_path(file).expect("a file of data");
    reader.deserialize().map(|row| row.expect("as many cells as columns")).collect()
}

#[test]
fn the_map_that_learns_renders_and_is_compared() {
    let folder = tempfile::tempdir().expect("a folder");
    let done = |args: &[&str]| {
        let done = occlude(args, folder.path());
        assert_eq!(done.status.code(), Some(0), "{args:?}: {}", text(&done.stderr));
    };
    let columns = scene("columns");
    let common = ["render", columns.as_str(), "--size", "64x36", "--spp", "9", "-q"];
    for (name, options) in [
        ("auto.exr", &["--method", "auto", "--threads", "1"][..]),
        ("again.exr", &["--method", "auto", "--threads", "3"]),
        ("plain.exr", &["--method", "auto", "--adaptive", "off"]),
        ("exact.exr", &["--method", "exact", "--adaptive", "on"]),
    ] {
        done(&[&common[..], &["-o", name], options].concat());
    }
    let read = |name: &str| std::fs::read(folder.path().join(name)).expect(name);
    assert!(read("auto.exr") == read("again.exr"), "the same for any number of threads");
    assert!(read("auto.exr") != read("plain.exr"));
    done(&[&common[..], &["-o", "default.exr"]].concat());
    assert!(read("auto.exr") == read("default.exr"), "it is the default");

    // With a single ray some averages come out below 0; what is written does not.
    done(&[
        "render",
        &columns,
        "--size",
        "96x54",
        "-q",
        "--shadow-rays",
        "1",
        "-o",
        "one.pfm",
        "--stats",
        "one.json",
    ]);
    let stats = std::fs::read_to_string(folder.path().join("one.json")).expect("statistics");
    let stats: serde_json::Value = serde_json::from_str(&stats).expect("JSON");
    assert!(stats["settled"]["pixels"].as_u64() > Some(0), "{}", stats["settled"]);
    assert!(stats["settled"]["part"].as_f64() < Some(1e-3), "{}", stats["settled"]);
    let compared = occlude(&["compare", "--json", "one.pfm", "one.pfm"], folder.path());
    let found: serde_json::Value = serde_json::from_str(&text(&compared.stdout)).expect("JSON");
    assert_eq!((&found["negative"], &found["nan"]), (&0.into(), &0.into()));

    done(&[
        "compare-methods",
        &columns,
        "--size",
        "64x36",
        "--spp",
        "3",
        "--shadow-rays",
        "12",
        "--reference-rays",
        "64",
        "-o",
        "page",
    ]);
    let page = folder.path().join("page");
    let found = rows(&page.join("methods.csv"));
    assert_eq!(
        found.iter().map(|row| row["method"].as_str()).collect::<Vec<_>>(),
        ["exact", "auto", "stochastic", "map"]
    );
    for row in &found {
        assert!(row["rmse"].parse::<f64>().expect("a number") > 0.0);
        assert!(row["gain_visibility"].parse::<f64>().expect("a number") > 0.0);
    }
    assert_eq!(rows(&page.join("passes.csv")).len(), 4 * 3, "after 1, 2 and 3 passes");
    assert_eq!(rows(&page.join("classes.csv")).len(), 4 * 3, "lit, dark and penumbra");
    let guard = rows(&page.join("guard.csv"));
    assert_eq!(guard.len(), 3);
    for row in &guard {
        let part = |name: &str| row[name].parse::<f64>().expect("a number");
        assert!(
            part("gamma") >= 0.0 && part("gain_measured") > 0.0 && part("gain_promised") > 0.0,
            "{row:?}"
        );
        // Not numbers until some cell has odds.
        assert!(["q", "r2", "m"].iter().all(|name| !(part(name) < 0.0 || part(name) > 1.0)), "{row:?}");
    }
    let html = String::from_utf8(std::fs::read(page.join("index.html")).expect("the page")).expect("text");
    roxmltree::Document::parse_with_options(
        &html,
        roxmltree::ParsingOptions { allow_dtd: true, ..Default::default() },
    )
    .expect("well formed");
    // A page of its own is replaced.
    done(&[
        "compare-methods",
        &columns,
        "--size",
        "32x18",
        "--spp",
        "1",
        "--methods",
        "exact,auto",
        "--reference-rays",
        "16",
        "-o",
        "page",
        "-q",
    ]);
}

#[test]
fn maps_are_saved_looked_into_used_and_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = |args: &[&str]| occlude(args, folder.path());
    let done = |args: &[&str]| {
        let done = run(args);
        assert_eq!(done.status.code(), Some(0), "{args:?}: {}", text(&done.stderr));
        text(&done.stdout)
    };
    let refused = |args: &[&str], why: &str| {
        let refused = run(args);
        let message = text(&refused.stderr);
        assert_eq!(refused.status.code(), Some(2), "{args:?}: {message}");
        assert!(message.contains(why), "{args:?}: {message}");
    };
    let (columns, plates) = (scene("columns"), scene("plates"));
    let size = ["--size", "48x27", "-q"];
    for (name, threads) in [("a.map", "1"), ("b.map", "3")] {
        let options =
            ["map", &columns, "-o", name, "--passes", "3", "--shadow-rays", "32", "--threads", threads];
        done(&[&options[..], &size].concat());
    }
    let read = |name: &str| std::fs::read(folder.path().join(name)).expect(name);
    assert!(read("a.map") == read("b.map"), "the same for any number of threads");
    for args in [&["map", "a.map"][..], &["map", "--inspect", "a.map"]] {
        let said = done(args);
        assert!(said.contains("learned from   3 passes of 32 shadow rays"), "{said}");
    }
    let render = |scene: &str, map: &str| {
        let args = ["render", scene, "--method", "auto", "--map", map, "-o", "picture.exr", "--spp", "2"];
        [&args[..], &size].concat().into_iter().map(str::to_owned).collect::<Vec<_>>()
    };
    let with = |owned: Vec<String>, then: &dyn Fn(&[&str])| {
        then(&owned.iter().map(String::as_str).collect::<Vec<_>>());
    };
    with(render(&columns, "a.map"), &|args| {
        done(args);
    });
    let picture = read("picture.exr");
    // Nothing is overwritten when a map is refused.
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).expect(name);
    let bytes = read("a.map");
    write("short.map", &bytes[..bytes.len() / 2]);
    let mut damaged = bytes.clone();
    damaged[bytes.len() / 2] ^= 1;
    write("damaged.map", &damaged);
    let mut version = bytes.clone();
    version[12] = 200;
    write("version.map", &version);
    let mut turned = bytes.clone();
    turned[8..12].reverse();
    write("turned.map", &turned);
    write("other.map", b"P6 1 1 255 abc");
    for (map, why) in [
        ("short.map", "ends early"),
        ("damaged.map", "is damaged"),
        ("version.map", "is of version 200"),
        ("turned.map", "other order"),
        ("other.map", "is not a map"),
        ("absent.map", "reading absent.map"),
    ] {
        with(render(&columns, map), &|args| refused(args, why));
        refused(&["map", map], why);
    }
    with(render(&plates, "a.map"), &|args| refused(args, "belongs to other triangles or lights"));
    assert!(read("picture.exr") == picture);

    refused(&["map", &columns], "is a scene: say where to write its map, with -o FILE");
    refused(&["map", &columns, "-o", "no/such/folder.map"], "no/such");
    refused(
        &["render", &columns, "--method", "exact", "--map", "a.map"],
        "--map is an option of --method auto",
    );
    refused(&["render", &columns, "--method", "map", "--map-memory", "1M"], "--map-memory is an option of");
    refused(&["render", &columns, "--method", "auto", "--map-memory", "lots"], "wants a number of bytes");
    done(
        &[
            &[
                "render",
                &columns,
                "--method",
                "auto",
                "--map-memory",
                "100k",
                "-o",
                "small.png",
                "--spp",
                "1",
            ][..],
            &size,
        ]
        .concat(),
    );
}

#[test]
fn the_theory_is_reproduced() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = |threads: &str, into: &str| {
        let done =
            occlude(&["reproduce", "theory", "--quick", "--threads", threads, "-o", into], folder.path());
        assert_eq!(done.status.code(), Some(0), "{}", text(&done.stderr));
        assert!(done.stdout.is_empty(), "{}", text(&done.stdout));
        assert!(text(&done.stderr).contains("wrote"), "{}", text(&done.stderr));
    };
    run("1", "new/one");
    run("3", "two");
    let (one, two) = (folder.path().join("new/one"), folder.path().join("two"));

    let count = std::fs::read_dir(&one).expect("a folder").count();
    assert_eq!(count, 1 + FILES.len(), "the page and its data");
    assert!(FILES.iter().all(|file| one.join(file).exists()));
    // Everything but times is the same for any number of threads.
    for file in ["variance.csv", "plates.csv", "halving.csv", "eight_plates.csv"] {
        let [one, two] = [&one, &two].map(|folder| std::fs::read(folder.join(file)).expect(file));
        assert!(one.len() > 200 && one == two, "{file}");
    }
    let [efficiency, again] = [&one, &two].map(|folder| rows(&folder.join("efficiency.csv")));
    assert!(efficiency.len() > 60 && efficiency.len() == again.len());
    for (row, again) in efficiency.iter().zip(&again) {
        for column in ["scene", "method", "rmse", "triangle_tests_per_ray"] {
            assert_eq!(row[column], again[column], "{column}");
        }
        let number = |column: &str| row[column].parse::<f64>().expect(column);
        assert!(number("rmse") > 0.0 && number("efficiency_visibility") > 0.0, "{row:?}");
    }

    // The closed forms, the samples, and the one slip of the slides' tables.
    let variances = rows(&one.join("variance.csv"));
    let slips: Vec<_> = variances.iter().filter(|row| row["slides_agree"] == "no").collect();
    assert_eq!(slips.len(), 2, "{slips:?}");
    for row in &variances {
        let number = |column: &str| row[column].parse::<f64>().expect(column);
        let (closed, sampled) = (number("variance_closed_form"), number("variance_sampled"));
        let room = 6.0 / 1.96 * number("variance_half_width_95") + 1e-5 * closed;
        assert!((closed - sampled).abs() <= room, "{row:?}");
        let room = 6.0 / 1.96 * number("mean_half_width_95") + 1e-6;
        assert!((number("mean_sampled") - number("v")).abs() <= room, "{row:?}");
    }
    assert!(slips.iter().all(|row| row["variance_closed_form"].starts_with("9.300")), "{slips:?}");

    let page = std::fs::read_to_string(one.join("index.html")).expect("a page");
    let options = roxmltree::ParsingOptions { allow_dtd: true, ..Default::default() };
    let document = roxmltree::Document::parse_with_options(&page, options).expect("well-formed");
    assert!(!says(&document, "NaN"), "a number is missing");
    let count = |tag: &str| document.descendants().filter(|node| node.has_tag_name(tag)).count();
    assert!(
        count("section") == 5 && count("img") > 50 && count("svg") > 10,
        "{} {}",
        count("img"),
        count("svg")
    );
    for link in
        document.descendants().filter(|node| node.has_tag_name("a")).filter_map(|node| node.attribute("href"))
    {
        assert!(link.starts_with('#') || one.join(link).exists(), "{link}");
    }

    // Its own page is replaced, anything else is not.
    let foreign = folder.path().join("foreign");
    std::fs::create_dir(&foreign).expect("a folder");
    std::fs::write(foreign.join("index.html"), "mine").expect("a file");
    let done = occlude(&["reproduce", "theory", "--quick", "-o", "foreign"], folder.path());
    assert_eq!(done.status.code(), Some(2), "{}", text(&done.stderr));
    assert_eq!(std::fs::read_to_string(foreign.join("index.html")).expect("still there"), "mine");
    let stopped = occlude(&["reproduce", "theory", "-o", "two/index.html"], folder.path());
    assert_eq!(stopped.status.code(), Some(2), "{}", text(&stopped.stderr));
}

#[cfg(unix)]
#[test]
fn an_interrupted_reproduction_leaves_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let said = interrupted(&["reproduce", "theory", "-o", "a/b"], folder.path());
    assert!(said.contains("nothing was written"), "{said}");
    assert!(!folder.path().join("a").exists());
}

#[test]
fn maps_render_and_are_shown() {
    let folder = tempfile::tempdir().expect("a folder");
    let plates = scene("plates");
    let common = ["--size", "32x24", "--photons", "5000"];
    let small = ["--spp", "1", "--shadow-rays", "8", "--quiet", "-o", "a.pfm", "--stats", "s.json"];
    let ways: [(&[&str], &str); 9] = [
        (&["--method", "map"], "map"),
        (&["--method", "map", "--blockers", "triangle"], "map"),
        (&["--method", "map", "--blocker-kind", "object"], "map"),
        (&["--method", "stochastic", "--blockers", "map"], "map + stochastic balanced uniform random"),
        (
            &[
                "--method",
                "stochastic",
                "--blockers",
                "map",
                "--blocker-kind",
                "triangle",
                "--split",
                "sorted",
                "--probabilities",
                "optimal",
                "--decomposition",
                "residual",
                "--quotas",
            ],
            "map + stochastic residual optimal sorted quotas",
        ),
        (&["--method", "map", "--photon-rounds", "3"], "map"),
        (&["--method", "map", "--blocker-trees", "--volumetric", "off"], "map, trees"),
        (
            &["--method", "stochastic", "--blockers", "map", "--split", "treelet", "--volumetric", "on"],
            "map + stochastic balanced uniform treelet",
        ),
        (
            &[
                "--method",
                "stochastic",
                "--blockers",
                "map",
                "--blocker-trees",
                "--split",
                "sorted",
                "--probabilities",
                "importance",
                "--test-rays",
                "cell",
                "--photon-rounds",
                "2",
            ],
            "map + stochastic balanced importance sorted, trees, by cells",
        ),
    ];
    for (way, name) in ways {
        let args = [&["render", &plates][..], &common, &small, way].concat();
        let done = occlude(&args, folder.path());
        assert_eq!(done.status.code(), Some(0), "{way:?}: {}", text(&done.stderr));
        let json = std::fs::read_to_string(folder.path().join("s.json")).expect("statistics");
        let stats: serde_json::Value = serde_json::from_str(&json).expect("JSON");
        assert_eq!(stats["method"], name);
        assert_eq!(stats["map"]["lines"], 5000);
        let rounds = way.iter().position(|arg| *arg == "--photon-rounds").map_or("1", |at| way[at + 1]);
        assert_eq!(stats["map"]["rounds"].to_string(), rounds);
        assert_eq!(stats["map"]["adaptive"], rounds != "1");
        assert_eq!(stats["map"]["later_lines"], if rounds == "1" { 0 } else { 2500 });
        assert!(stats["map"]["penumbra"].as_u64() > Some(0), "{json}");
    }
    for file in ["m.png", "m.ply"] {
        let args = [&["photons", &plates, "-o", file][..], &common].concat();
        let done = occlude(&args, folder.path());
        assert_eq!(done.status.code(), Some(0), "{}", text(&done.stderr));
        assert!(folder.path().join(file).metadata().expect(file).len() > 100);
    }
}

#[test]
fn the_map_is_reproduced() {
    let folder = tempfile::tempdir().expect("a folder");
    let done = occlude(&["reproduce", "map", "--quick", "-o", "page"], folder.path());
    assert_eq!(done.status.code(), Some(0), "{}", text(&done.stderr));
    let page = folder.path().join("page");
    let html = std::fs::read_to_string(page.join("index.html")).expect("a page");
    assert!(html.contains("left out"), "says which scenes are not there");
    let results = rows(&page.join("map.csv"));
    assert_eq!(results.len(), 4 * 19);
    for row in &results {
        assert!(row["rmse"].parse::<f64>().expect("a number") > 0.0, "{row:?}");
    }
    let calls = rows(&page.join("calls.csv"));
    assert_eq!(calls.len(), 4 * 4);
    for row in &calls {
        let number = |column: &str| row[column].parse::<u64>().expect("a number");
        let parts = ["lit", "dark", "penumbra", "unknown"].map(number);
        assert_eq!(parts.iter().sum::<u64>(), number("points_and_lights"), "{row:?}");
    }
    let of = |scene: &str, method: &str, column: &str| -> f64 {
        let row = results.iter().find(|row| row["scene"] == scene && row["method"] == method);
        row.expect("a row")[column].parse().expect("a number")
    };
    for scene in ["spheres", "city", "forest", "sponge"] {
        let tests = |method: &str| of(scene, method, "triangle_tests");
        assert_eq!(of(scene, "plain: map", "rmse"), of(scene, "trees for each point: map", "rmse"));
        assert!(tests("plain: map + stochastic") < tests("plain: map"), "{scene}");
        let [none, cell, point] = ["plain", "importance for each cell", "importance for each point"]
            .map(|name| tests(&format!("{name}: map + stochastic")));
        assert!(none < cell && cell < point, "{scene}: {none} {cell} {point}");
    }
    assert_eq!(rows(&page.join("photons.csv")).len(), 4 * 3 * 2);
    assert_eq!(rows(&page.join("why.csv")).len(), 4 * 3 * 2);
    let rounds = rows(&page.join("rounds.csv"));
    assert_eq!(rounds.len(), 4 * 2 * 2 * 2);
    let missed = |many: &str| -> f64 {
        let of = rounds.iter().filter(|row| row["rounds"] == many);
        of.map(|row| row["missed_blockers"].parse::<f64>().expect("a number")).sum()
    };
    // Over all scenes; about a quarter, so that half is far from what chance does.
    assert!(missed("3") < 0.5 * missed("1"), "{} {}", missed("3"), missed("1"));
}
