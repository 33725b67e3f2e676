//! The command as a user meets it: what it prints, what it writes, how it ends.

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
    // In a pipe a line a pass.
    assert_eq!(text(&done.stderr).lines().filter(|line| line.starts_with("pass ")).count(), 3);
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
    let cases: &[(&[&str], &str)] = &[
        (&["render", "nowhere"], "nowhere"),
        (&["render", &cornell, "-o", "a.jpg"], "png"),
        (&["render", &cornell, "-o", "missing/a.png"], "missing"),
        (&["render", &cornell, "--spp", "0"], "spp"),
        (&["render", &cornell, "--size", "12"], "1280x720"),
        (&["render", &cornell, "--size", "0x9"], "size"),
        (&["render", &cornell, "--vfov", "180"], "vfov"),
        (&["render", &cornell, "--eye", "1,2"], "three numbers"),
        (&["render", &cornell, "--reference", "none.exr"], "none.exr"),
        (&["render", &cornell, "--split", "sorted"], "--split is an option of --method stochastic"),
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

#[cfg(unix)]
#[test]
fn interrupting_keeps_what_there_is() {
    let folder = tempfile::tempdir().expect("a folder");
    let child = Command::new(PROGRAM)
        .args(["render", &scene("columns"), "-o", "a.png", "--spp", "100000"])
        .current_dir(folder.path())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("it starts");
    std::thread::sleep(std::time::Duration::from_millis(1500));
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill");
    assert!(killed.success());
    let done = child.wait_with_output().expect("it ends");
    let said = text(&done.stderr);
    assert_eq!(done.status.code(), Some(1), "{said}");
    assert!(said.contains("interrupted after"), "{said}");
    assert!(folder.path().join("a.png").exists());
}
