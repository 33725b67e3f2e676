//! A pinhole camera, and how the one to use is found.

use std::path::{Path, PathBuf};

use glam::{DVec3, Vec3};
use serde_json::Value;

use crate::error::{Error, Result};

/// A pinhole camera; `camera.json` has these keys.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Camera {
    /// The pinhole.
    pub eye: Vec3,
    /// The point in the middle of the image.
    pub target: Vec3,
    /// Any direction that points up in the image; not along the view.
    pub up: Vec3,
    /// The full vertical angle of view, degrees, above 0 and below 180.
    pub vfov_deg: f32,
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
}

/// The most pixels an image may have along one side.
pub const MAX_SIDE: u32 = 1 << 16;
/// The most pixels an image may have in all.
pub const MAX_PIXELS: u64 = 1 << 28;

/// The largest magnitude of a camera's coordinate: the whole of the largest scene can be seen from there.
const MAX_DISTANCE: f32 = 10.0 * super::MAX_COORDINATE;

/// The angle of view of a camera that nobody described, degrees.
const VFOV: f32 = 40.0;
/// The image of a camera that nobody described.
const SIZE: (u32, u32) = (1280, 720);
/// From the middle of the scene to the camera that nobody placed: a three-quarter view.
const STAND: DVec3 = DVec3::new(0.6, 0.45, 1.0);

impl Camera {
    /// A camera that sees the whole box from `lo` to `hi`: three-quarter view, +Y up, 1280 by 720.
    pub fn framing(lo: Vec3, hi: Vec3) -> Self {
        let mut camera =
            Self { eye: lo, target: hi, up: Vec3::Y, vfov_deg: VFOV, width: SIZE.0, height: SIZE.1 };
        camera.target = (lo.as_dvec3() * 0.5 + hi.as_dvec3() * 0.5).as_vec3();
        camera.eye = camera.stand_back(lo, hi);
        camera
    }

    /// Where to stand, looking at `target` in three-quarter view, to see the whole box.
    fn stand_back(&self, lo: Vec3, hi: Vec3) -> Vec3 {
        let (lo, hi, target) = (lo.as_dvec3(), hi.as_dvec3(), self.target.as_dvec3());
        let (forward, right, up) = basis(-STAND, self.up.as_dvec3());
        let tan_y = (f64::from(self.vfov_deg).to_radians() * 0.5).tan();
        let tan_x = tan_y * f64::from(self.width) / f64::from(self.height);
        let mut distance = 0.0f64;
        for corner in 0..8 {
            let pick = |bit: u32, lo: f64, hi: f64| if corner & bit == 0 { lo } else { hi };
            let p = DVec3::new(pick(1, lo.x, hi.x), pick(2, lo.y, hi.y), pick(4, lo.z, hi.z)) - target;
            let across = (p.dot(right).abs() / tan_x).max(p.dot(up).abs() / tan_y);
            distance = distance.max(across - p.dot(forward));
        }
        if distance <= 0.0 {
            // All of it is seen from the target already.
            let size = (hi - lo).length();
            distance = if size > 0.0 { size } else { 1.0 };
        }
        // Or rounding would put it on the target.
        let distance = distance.max(target.abs().max_element() * 1e-6);
        (target - forward * (distance * 1.05)).as_vec3()
    }

    /// The directions of the image, computed in double precision.
    ///
    /// An `up` along the view is replaced by the axis that is furthest from the view.
    pub fn frame(&self) -> Frame {
        let view = self.target.as_dvec3() - self.eye.as_dvec3();
        let (forward, right, up) = basis(view, self.up.as_dvec3());
        let half_height = (f64::from(self.vfov_deg).to_radians() * 0.5).tan();
        let half_width = half_height * f64::from(self.width) / f64::from(self.height);
        Frame {
            forward: forward.as_vec3(),
            right: right.as_vec3(),
            up: up.as_vec3(),
            across: (right * half_width).as_vec3(),
            upwards: (up * half_height).as_vec3(),
            per_pixel: [2.0 / self.width as f32, 2.0 / self.height as f32],
        }
    }

    /// [`Frame::ray_direction`], for a caller with one ray; for many, keep the [`Frame`].
    pub fn ray_direction(&self, px: f32, py: f32) -> Vec3 {
        self.frame().ray_direction(px, py)
    }

    /// Refuses a camera through which nothing can be seen, and an image too large to hold.
    pub fn check(&self) -> Result<()> {
        Draft {
            eye: Some(self.eye),
            target: Some(self.target),
            up: Some(self.up),
            vfov_deg: Some(self.vfov_deg),
            size: (Some(self.width), Some(self.height)),
            ..Draft::default()
        }
        .check()
    }
}

/// The directions of a camera's image, ready for one ray per sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// Into the scene, of unit length.
    pub forward: Vec3,
    /// To the right of the image, of unit length.
    pub right: Vec3,
    /// To the top of the image, of unit length.
    pub up: Vec3,
    across: Vec3,  // from the middle of the image plane to its right edge
    upwards: Vec3, // and to its top edge
    per_pixel: [f32; 2],
}

impl Frame {
    /// The unit direction in which the point (`px`, `py`) of the image is seen.
    ///
    /// `px` runs from 0 to `width`, `py` from 0 to `height`; pixel (0, 0) is the top left one and
    /// its middle is (0.5, 0.5). With t the tangent of half the angle of view,
    ///
    /// ```text
    ///     forward + t ((2 px / width - 1) (width / height) right + (1 - 2 py / height) up).
    /// ```
    #[inline]
    pub fn ray_direction(&self, px: f32, py: f32) -> Vec3 {
        let x = px * self.per_pixel[0] - 1.0;
        let y = 1.0 - py * self.per_pixel[1];
        (self.forward + x * self.across + y * self.upwards).normalize()
    }
}

/// Forward, right and up, orthonormal, from a view and a rough `up`.
fn basis(view: DVec3, up: DVec3) -> (DVec3, DVec3, DVec3) {
    let forward = view.normalize_or(DVec3::NEG_Z);
    let up = if is_along(forward, up) { other_axis(forward) } else { up.normalize() };
    let right = forward.cross(up).normalize();
    (forward, right, right.cross(forward))
}

/// Whether `up` says nothing about where up is. `forward` has unit length.
fn is_along(forward: DVec3, up: DVec3) -> bool {
    up.try_normalize().is_none_or(|up| forward.cross(up).length() < 1e-6)
}

/// The axis furthest from the view.
fn other_axis(forward: DVec3) -> DVec3 {
    let [x, y, z] = forward.abs().to_array();
    if y <= x && y <= z {
        DVec3::Y
    } else if z <= x {
        DVec3::Z
    } else {
        DVec3::X
    }
}

/// What the caller wants of the camera; the default leaves everything to the scene.
///
/// `file` stands in for the `camera.json` beside the scene, and each of the others for one key.
/// Messages name them as the command line does: `--camera`, `--eye`, `--target`, `--up`, `--vfov`, `--size`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraRequest {
    /// A camera file to read instead of the `camera.json` beside the scene.
    pub file: Option<PathBuf>,
    /// Replaces [`Camera::eye`].
    pub eye: Option<Vec3>,
    /// Replaces [`Camera::target`].
    pub target: Option<Vec3>,
    /// Replaces [`Camera::up`].
    pub up: Option<Vec3>,
    /// Replaces [`Camera::vfov_deg`].
    pub vfov_deg: Option<f32>,
    /// Replaces [`Camera::width`] and [`Camera::height`].
    pub size: Option<(u32, u32)>,
}

impl CameraRequest {
    /// Reads the camera file, if there is one, and checks all that is known before the scene is.
    pub(super) fn read(&self, folder: &Path) -> Result<Draft> {
        let beside = folder.join("camera.json");
        let (path, text) = match &self.file {
            Some(path) => {
                (path, Some(std::fs::read(path).map_err(Error::io("reading the camera file", path))?))
            }
            None => match std::fs::read(&beside) {
                Ok(text) => (&beside, Some(text)),
                Err(e) if e.kind() == std::io::ErrorKind::NotFound => (&beside, None),
                Err(e) => return Err(Error::io("reading the camera file", &beside)(e)),
            },
        };
        let mut draft = Draft { asked: self.clone(), ..Draft::default() };
        if let Some(text) = text {
            draft.file = Some(path.clone());
            draft.fill(path, &text)?;
        }
        draft.eye = self.eye.or(draft.eye);
        draft.target = self.target.or(draft.target);
        draft.up = self.up.or(draft.up);
        draft.vfov_deg = self.vfov_deg.or(draft.vfov_deg);
        if let Some((width, height)) = self.size {
            draft.size = (Some(width), Some(height));
        }
        draft.check()?;
        Ok(draft)
    }
}

/// A camera, as far as the file and the options describe it.
#[derive(Debug, Default)]
pub(super) struct Draft {
    file: Option<PathBuf>,
    asked: CameraRequest,
    eye: Option<Vec3>,
    target: Option<Vec3>,
    up: Option<Vec3>,
    vfov_deg: Option<f32>,
    size: (Option<u32>, Option<u32>),
    keys: Vec<(String, u64)>,
}

impl Draft {
    /// The camera file, if there is one.
    pub(super) fn file(&self) -> Option<&Path> {
        self.file.as_deref()
    }

    /// Takes over the keys of a camera file. Only a key that an option replaces may be missing.
    fn fill(&mut self, path: &Path, text: &[u8]) -> Result<()> {
        let text = text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text);
        let value: Value = serde_json::from_slice(text).map_err(|e| {
            let whole = e.to_string();
            let what = whole.split(" at line ").next().unwrap_or(&whole);
            let message = format!("not valid JSON: {what}, column {}; mend the text there", e.column());
            Error::line(path, (e.line() as u64).max(1), message)
        })?;
        let Value::Object(keys) = value else {
            return Err(Error::input(path, r#"a camera is an object: {"eye": [0, 1, 5], ...}"#));
        };
        self.keys = keys_of(text);
        for (k, (key, line)) in self.keys.iter().enumerate() {
            if let Some((_, first)) = self.keys[..k].iter().find(|(other, _)| other == key) {
                let what = format!("`{key}` stands on line {first} already; leave one of them out");
                return Err(Error::line(path, *line, what));
            }
        }
        let get = |key: &str, replaced: bool| match keys.get(key) {
            _ if replaced => Ok(None),
            Some(value) => Ok(Some(value)),
            None => {
                let what = format!(
                    "the key `{key}` is missing; add it{}",
                    self.said_unknown(", and mend or remove ")
                );
                Err(Error::input(path, what))
            }
        };
        let fault = |key: &str, what: String| self.fault(key, key, false, &what);
        let vector = |key: &str, value| vector(value).map_err(|what| fault(key, what));
        let eye = get("eye", self.asked.eye.is_some())?.map(|v| vector("eye", v)).transpose()?;
        let target = get("target", self.asked.target.is_some())?.map(|v| vector("target", v)).transpose()?;
        let up = get("up", self.asked.up.is_some())?.map(|v| vector("up", v)).transpose()?;
        let vfov_deg = get("vfov_deg", self.asked.vfov_deg.is_some())?
            .map(|v| number(v).map_err(|what| fault("vfov_deg", what)))
            .transpose()?;
        let pixels = |key: &str, value| pixels(value).map_err(|what| fault(key, what));
        let sized = self.asked.size.is_some();
        let width = get("width", sized)?.map(|v| pixels("width", v)).transpose()?;
        let height = get("height", sized)?.map(|v| pixels("height", v)).transpose()?;
        (self.eye, self.target, self.up, self.vfov_deg, self.size) =
            (eye, target, up, vfov_deg, (width, height));
        Ok(())
    }

    /// The keys that no camera has, with their lines, behind a few words; nothing if there are none.
    fn said_unknown(&self, before: &str) -> String {
        const KNOWN: [&str; 6] = ["eye", "target", "up", "vfov_deg", "width", "height"];
        let unknown = self.keys.iter().filter(|(key, _)| !KNOWN.contains(&key.as_str()));
        let list: Vec<String> = unknown.map(|(key, line)| format!("`{key}` (line {line})")).collect();
        if list.is_empty() { String::new() } else { format!("{before}{}", list.join(", ")) }
    }

    /// Refuses what no scene could make right.
    fn check(&self) -> Result<()> {
        let asked = &self.asked;
        let vectors = [
            ("eye", self.eye, asked.eye.is_some()),
            ("target", self.target, asked.target.is_some()),
            ("up", self.up, asked.up.is_some()),
        ];
        for (key, value, is_option) in vectors {
            // A direction may have any length.
            let most = if key == "up" { f32::MAX } else { MAX_DISTANCE };
            if value.is_some_and(|v| !(v.is_finite() && v.abs().max_element() <= most)) {
                let what = match key {
                    "up" => "has a number that is not finite; write three ordinary numbers".to_owned(),
                    _ => {
                        format!("has a number that is not finite or is beyond {most:e}; scale the scene down")
                    }
                };
                return Err(self.fault(key, key, is_option, &what));
            }
        }
        if let Some(vfov) = self.vfov_deg
            && !(vfov > 0.0 && vfov < 180.0)
        {
            let what = format!("is {vfov}; the angle of view must be above 0 and below 180 degrees");
            return Err(self.fault("vfov_deg", "vfov", asked.vfov_deg.is_some(), &what));
        }
        let sized = asked.size.is_some();
        for (key, side) in [("width", self.size.0), ("height", self.size.1)] {
            if let Some(side) = side
                && !(1..=MAX_SIDE).contains(&side)
            {
                let what = if sized { format!("has the {key} {side}") } else { format!("is {side}") };
                let what = format!("{what}; it must be 1 to {MAX_SIDE} pixels");
                return Err(self.fault(key, "size", sized, &what));
            }
        }
        if let (Some(width), Some(height)) = self.size
            && u64::from(width) * u64::from(height) > MAX_PIXELS
        {
            let what = format!("make {width} x {height} pixels; an image may have {MAX_PIXELS}");
            return Err(self.fault("width` and `height", "size", sized, &what));
        }
        if let (Some(eye), Some(target)) = (self.eye, self.target)
            && eye == target
        {
            let is_option = asked.eye.is_some() || asked.target.is_some();
            let what = "are the same point, so there is nothing to look at; move one of them";
            return Err(self.fault("eye` and `target", "eye and --target", is_option, what));
        }
        Ok(())
    }

    /// Fills in what is missing with a view of the box, and mends an `up` along the view.
    pub(super) fn complete(self, (lo, hi): (Vec3, Vec3), warnings: &mut Vec<String>) -> Result<Camera> {
        let unknown = self.said_unknown("ignored the unknown keys ");
        if let (Some(path), false) = (&self.file, unknown.is_empty()) {
            warnings.push(format!("{}: {unknown}", path.display()));
        }
        let mut camera = Camera::framing(lo, hi);
        camera.target = self.target.unwrap_or(camera.target);
        camera.up = self.up.unwrap_or(camera.up);
        camera.vfov_deg = self.vfov_deg.unwrap_or(camera.vfov_deg);
        camera.width = self.size.0.unwrap_or(camera.width);
        camera.height = self.size.1.unwrap_or(camera.height);
        camera.eye = self.eye.unwrap_or_else(|| camera.stand_back(lo, hi));
        let whole = Self {
            eye: Some(camera.eye),
            target: Some(camera.target),
            up: Some(camera.up),
            vfov_deg: Some(camera.vfov_deg),
            size: (Some(camera.width), Some(camera.height)),
            ..self
        };
        whole.check()?;

        let forward = (camera.target.as_dvec3() - camera.eye.as_dvec3()).normalize();
        if is_along(forward, camera.up.as_dvec3()) {
            let given = camera.up;
            camera.up = other_axis(forward).as_vec3();
            warnings
                .push(format!("the camera's up {given} lies along its view; {} is used instead", camera.up));
        }
        Ok(camera)
    }

    /// An error about a key of the file, or about the option that replaced it.
    fn fault(&self, key: &str, option: &str, is_option: bool, what: &str) -> Error {
        match &self.file {
            _ if is_option => Error::Usage(format!("--{option} {what}")),
            Some(path) => {
                let first = key.split('`').next();
                let line =
                    self.keys.iter().find(|(key, _)| Some(key.as_str()) == first).map(|(_, line)| *line);
                Error::Input { path: path.clone(), line, message: format!("`{key}` {what}") }
            }
            None => Error::Usage(format!("the camera's `{key}` {what}")),
        }
    }
}

/// Three numbers of a camera file; or what is wrong with them.
fn vector(value: &Value) -> std::result::Result<Vec3, String> {
    let numbers: Option<Vec<f32>> =
        value.as_array().and_then(|v| v.iter().map(|x| x.as_f64().map(|x| x as f32)).collect());
    match numbers.as_deref() {
        Some(&[x, y, z]) => Ok(Vec3::new(x, y, z)),
        _ => Err(format!("is {}; write three numbers, [x, y, z]", shown(value))),
    }
}

/// A number of a camera file.
fn number(value: &Value) -> std::result::Result<f32, String> {
    value.as_f64().map(|x| x as f32).ok_or_else(|| format!("is {}; write a number", shown(value)))
}

/// A number of pixels in a camera file. `96.0` will do, as some programs write all numbers like that.
fn pixels(value: &Value) -> std::result::Result<u32, String> {
    let whole = value.as_f64().filter(|x| x.fract() == 0.0 && (1.0..=f64::from(MAX_SIDE)).contains(x));
    let fault = || format!("is {}; write a whole number of pixels, 1 to {MAX_SIDE}", shown(value));
    whole.map(|x| x as u32).ok_or_else(fault)
}

/// The keys of an object of JSON that is valid, and their lines: its parser keeps the last of two equal ones, and no line.
fn keys_of(text: &[u8]) -> Vec<(String, u64)> {
    let (mut keys, mut depth, mut line, mut at) = (Vec::new(), 0, 1, 0);
    while at < text.len() {
        match text[at] {
            b'\n' => line += 1,
            b'{' | b'[' => depth += 1,
            b'}' | b']' => depth -= 1,
            b'"' => {
                let start = at + 1;
                at = start;
                while at < text.len() && text[at] != b'"' {
                    at += if text[at] == b'\\' { 2 } else { 1 };
                }
                let string = &text[start.min(text.len())..at.min(text.len())];
                let behind = text.get(at + 1..).unwrap_or_default().trim_ascii_start();
                if depth == 1 && behind.first() == Some(&b':') {
                    let quoted = &text[start - 1..(at + 1).min(text.len())];
                    let key = serde_json::from_slice(quoted);
                    keys.push((key.unwrap_or_else(|_| String::from_utf8_lossy(string).into_owned()), line));
                }
            }
            _ => {}
        }
        at += 1;
    }
    keys
}

/// The beginning of a JSON value, for a message.
fn shown(value: &Value) -> String {
    let text = value.to_string();
    if text.chars().count() <= 60 { text } else { text.chars().take(60).chain("...".chars()).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    const JSON: &str = r#"{"eye": [2, 2, 3], "target": [0, 1, 0], "up": [0, 1, 0],
        "vfov_deg": 45, "width": 96, "height": 64}"#;

    fn read(json: &str, request: &CameraRequest) -> Result<(Camera, Vec<String>)> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("camera.json"), json).unwrap();
        let mut warnings = Vec::new();
        let camera = request.read(folder.path())?.complete((Vec3::ZERO, Vec3::ONE), &mut warnings)?;
        Ok((camera, warnings))
    }

    fn message(from: &str, to: &str) -> String {
        assert!(JSON.contains(from), "{from}");
        read(&JSON.replace(from, to), &CameraRequest::default()).unwrap_err().to_string()
    }

    #[test]
    fn what_a_file_says() {
        let (camera, warnings) = read(JSON, &CameraRequest::default()).unwrap();
        assert_eq!(camera.eye, Vec3::new(2.0, 2.0, 3.0));
        assert_eq!((camera.vfov_deg, camera.width, camera.height), (45.0, 96, 64));
        assert!(warnings.is_empty());
    }

    #[test]
    fn faults_name_the_file_and_the_key() {
        for (from, to, key) in [
            ("96", "0", "width"),
            ("64", "-5", "height"),
            ("96", "2000000000", "width"),
            ("96", "65537", "width"),
            ("96", "1.5", "width"),
            ("45", "180", "vfov_deg"),
            ("45", "0", "vfov_deg"),
            ("45", "\"wide\"", "vfov_deg"),
            ("[2, 2, 3]", "[0, 1, 0]", "`eye` and `target`"),
            ("[2, 2, 3]", "[2, 2]", "eye"),
            ("[2, 2, 3]", "[2, 2, 1e39]", "eye"),
            ("[2, 2, 3]", "[2, 2, 2e9]", "eye"),
            ("\"eye\"", "\"eyes\"", "`eye` is missing"),
            ("96, \"height\": 64", "65536, \"height\": 65536", "`width` and `height`"),
        ] {
            let message = message(from, to);
            assert!(message.contains("camera.json") && message.contains(key), "{from} -> {to}: {message}");
            let line = if JSON.find(from) < JSON.find("vfov_deg") { 1 } else { 2 };
            let line = if key.contains("missing") { String::new() } else { format!(":{line}") };
            assert!(message.contains(&format!("camera.json{line}: ")), "{from} -> {to}: {message}");
        }
        assert!(message("\"eye\"", "\"eyes\"").contains("mend or remove `eyes` (line 1)"));
    }

    #[test]
    fn keys_have_lines_and_come_once() {
        let said = message("96,", "96,\n\"vfov_deg\" : 50,");
        assert!(said.contains("camera.json:3: `vfov_deg` stands on line 2 already"), "{said}");
        let text = b"{\"a\": {\"b\": [1, \"c\\\"\"]},\n\"d\": \"e:\",\r\n\"f\\\\\" : {}, \"\\u0065ye\": 1}";
        let keys = keys_of(text);
        assert_eq!(
            keys.iter().map(|(key, line)| (key.as_str(), *line)).collect::<Vec<_>>(),
            [("a", 1), ("d", 2), ("f\\", 3), ("eye", 3)]
        );
    }

    #[test]
    fn broken_json_names_the_line() {
        assert!(message("\"vfov_deg\": 45", "vfov_deg").contains("camera.json:2: "));
        assert!(message("[2, 2, 3]", "[2, 2, NaN]").contains("camera.json:1: "));
        assert!(read("[]", &CameraRequest::default()).is_err());
        assert!(read("", &CameraRequest::default()).is_err());
    }

    #[test]
    fn options_replace_keys_one_by_one() {
        let request = CameraRequest { size: Some((7, 5)), vfov_deg: Some(30.0), ..Default::default() };
        let json = JSON.replace("\"width\": 96, ", "").replace("\"vfov_deg\": 45,", "");
        let (camera, _) = read(&json, &request).unwrap();
        assert_eq!((camera.width, camera.height, camera.vfov_deg), (7, 5, 30.0));

        let message = |request| read(JSON, &request).unwrap_err().to_string();
        let eye = Some(Vec3::new(0.0, 1.0, 0.0));
        assert!(message(CameraRequest { eye, ..Default::default() }).starts_with("--eye and --target"));
        assert!(message(CameraRequest { size: Some((0, 9)), ..Default::default() }).starts_with("--size"));
        let vfov_deg = Some(f32::NAN);
        assert!(message(CameraRequest { vfov_deg, ..Default::default() }).starts_with("--vfov"));
    }

    #[test]
    fn odd_but_usable() {
        let (camera, warnings) =
            read(&JSON.replace("[2, 2, 3]", "[0, 9, 0]"), &CameraRequest::default()).unwrap();
        assert_ne!(camera.up, Vec3::Y);
        assert_eq!(warnings.len(), 1);
        let (_, warnings) = read(&JSON.replacen('{', "{\"fov\": 3,", 1), &CameraRequest::default()).unwrap();
        assert!(warnings[0].contains("ignored the unknown keys `fov` (line 1)"), "{warnings:?}");
    }

    #[test]
    fn the_middle_is_forward_and_the_corners_are_half_the_angle_away() {
        let (camera, _) = read(JSON, &CameraRequest::default()).unwrap();
        let frame = camera.frame();
        let to_target = (camera.target - camera.eye).normalize();
        assert!(frame.forward.distance(to_target) < 1e-6);
        assert!(camera.ray_direction(48.0, 32.0).distance(to_target) < 1e-6);
        let top = camera.ray_direction(48.0, 0.0);
        assert!((top.angle_between(to_target).to_degrees() - 22.5).abs() < 1e-2);
        assert!(top.y > to_target.y);
        let right = camera.ray_direction(96.0, 32.0).dot(frame.right);
        let tan = 22.5f32.to_radians().tan() * 1.5;
        assert!((right - tan / tan.hypot(1.0)).abs() < 1e-5);
    }

    #[test]
    fn a_camera_that_nobody_described_sees_the_scene() {
        for (lo, hi) in [
            (Vec3::new(-1.0, 0.0, -1.0), Vec3::new(5.0, 1.0, 9.0)),
            (Vec3::splat(1e5), Vec3::splat(1e5) + Vec3::X),
            (Vec3::ZERO, Vec3::new(1e-20, 1e-20, 0.0)),
            (Vec3::splat(-1e8), Vec3::splat(1e8)),
        ] {
            let camera = Camera::framing(lo, hi);
            camera.check().unwrap();
            let frame = camera.frame();
            let tan = 20f64.to_radians().tan();
            for i in 0..8 {
                let corner = Vec3::select(glam::BVec3::new(i & 1 != 0, i & 2 != 0, i & 4 != 0), hi, lo);
                let p = corner.as_dvec3() - camera.eye.as_dvec3();
                let depth = p.dot(frame.forward.as_dvec3());
                assert!(p.dot(frame.up.as_dvec3()).abs() <= depth * tan);
                assert!(p.dot(frame.right.as_dvec3()).abs() <= depth * tan * 1280.0 / 720.0);
            }
        }
    }

    #[test]
    fn a_frame_survives_an_up_along_the_view() {
        for up in [Vec3::Z, Vec3::NEG_Z, Vec3::ZERO] {
            let camera = Camera { eye: Vec3::ZERO, target: Vec3::Z, up, vfov_deg: 40.0, width: 4, height: 4 };
            assert!(camera.frame().right.is_normalized());
            assert!(camera.ray_direction(0.0, 0.0).is_normalized());
        }
    }
}
