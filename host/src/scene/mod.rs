//! Scenes as their files describe them: triangles, materials, a camera.

mod camera;
mod lines;
mod mtl;
mod obj;
mod polygon;

pub use camera::{Camera, CameraRequest, Frame, MAX_PIXELS, MAX_SIDE};

use std::fs::File;
use std::io::ErrorKind;
use std::ops::Range;
use std::path::{Path, PathBuf};

use glam::Vec3;

use crate::error::{Error, Result};

/// The largest magnitude of a coordinate. Beyond ten times that areas and their products leave what `f32` holds, and
/// pictures are wrong without a sign of it.
pub const MAX_COORDINATE: f32 = 1e8;

/// How far a scene has to reach along some axis, at the least; below a tenth of that pictures are wrong as well.
pub const MIN_EXTENT: f32 = 1e-8;

/// What a surface does with light. Both sides reflect; only the front emits.
#[derive(Clone, Debug, PartialEq)]
pub struct Material {
    /// As the file names it.
    pub name: String,
    /// Diffuse reflectance per channel (`Kd`), two-sided.
    pub diffuse: Vec3,
    /// Emitted radiance per channel (`Ke`), W/(m² sr), to the side of the geometric normal.
    pub emission: Vec3,
}

/// Triangles that the file groups under one name.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// As the file names it; empty before the first `o` or `g`.
    pub name: String,
    /// Its triangles.
    pub triangles: Range<u32>,
}

/// Everything a render needs to know, in one triangle soup.
///
/// A triangle `[a, b, c]` has the geometric normal `(b - a) x (c - a)`.
#[derive(Clone, Debug, Default)]
pub struct Scene {
    /// What to call it: the folder's or the file's name.
    pub name: String,
    /// Vertices, finite, not beyond [`MAX_COORDINATE`].
    pub positions: Vec<Vec3>,
    /// Three indices into `positions` each.
    pub triangles: Vec<[u32; 3]>,
    /// One index into `materials` for each triangle.
    pub triangle_materials: Vec<u32>,
    /// Materials.
    pub materials: Vec<Material>,
    /// Objects, in the order of their triangles, covering all of them.
    pub objects: Vec<Object>,
    /// The camera, if the file or the caller gave one.
    pub camera: Option<Camera>,
    /// What was odd but usable, a sentence each.
    pub warnings: Vec<String>,
    /// The files it was read from.
    pub files: Vec<PathBuf>,
}

impl Scene {
    /// The vertices of a triangle.
    #[inline]
    pub fn vertices(&self, triangle: u32) -> [Vec3; 3] {
        self.triangles[triangle as usize].map(|i| self.positions[i as usize])
    }

    /// The material of a triangle.
    #[inline]
    pub fn material(&self, triangle: u32) -> &Material {
        &self.materials[self.triangle_materials[triangle as usize] as usize]
    }

    /// The least and the greatest corner of all triangles; `None` if there are none.
    pub fn bounds(&self) -> Option<(Vec3, Vec3)> {
        let mut used = self.triangles.iter().flatten().map(|&i| self.positions[i as usize]);
        let first = used.next()?;
        Some(used.fold((first, first), |(lo, hi), p| (lo.min(p), hi.max(p))))
    }

    /// Whether any triangle emits.
    pub fn has_light(&self) -> bool {
        let emits: Vec<bool> = self.materials.iter().map(|m| m.emission.max_element() > 0.0).collect();
        self.triangle_materials.iter().any(|&m| emits[m as usize])
    }
}

/// Reads a scene and finds its camera.
///
/// `path` is an `.obj` file, or a folder with a `scene.obj` or with no other `.obj` than one. The
/// scene is named after it. The camera is that of the request's file, else of the `camera.json`
/// beside the OBJ, else one that sees all of the scene; the request may replace single keys.
///
/// What an OBJ may hold, beyond the ordinary:
///
/// - Polygons are split along the diagonals from their first vertex where that is right, and by
///   cutting ears where it is not; the triangles turn the way the polygon does. Where neither will
///   do, as the polygon crosses itself or has a dent and over 50 000 vertices, there is a warning.
/// - Triangles that are exactly without area are left out, with a warning.
/// - Faces before any `usemtl` are grey (`Kd 0.5`), with a warning. A material without `Kd` is grey
///   too, or black if it emits. Of materials of one name the last definition counts, with a warning;
///   `Kd` above 1 is used as it is, with a warning.
/// - Textures, normals, vertex colours, curves, points and lines are ignored.
/// - Names are bytes: any encoding will do, and blanks may be part of them.
///
/// Errors name the file and, where one is at fault, the line. A vertex that is not finite or is
/// beyond [`MAX_COORDINATE`], a scene smaller than [`MIN_EXTENT`], a face that names a vertex not defined above it, an unknown material, a missing
/// material file, a scene where nothing with an area emits: all are errors.
///
/// The OBJ is read as a stream. Of a closed mesh, a triangle costs about 45 bytes while loading, and
/// 22 of them stay.
pub fn load(path: &Path, camera: &CameraRequest) -> Result<Scene> {
    let file = scene_file(path)?;
    // Asked before opening: a pipe would wait for a writer.
    if !std::fs::metadata(&file).map_err(Error::io("reading", &file))?.is_file() {
        return Err(Error::input(&file, "this is not a file, and an OBJ file is wanted"));
    }
    let open = File::open(&file).map_err(Error::io("reading", &file))?;
    let draft = camera.read(file.parent().unwrap_or(Path::new("")))?;
    let mut scene = match file.extension() {
        Some(extension) if extension.eq_ignore_ascii_case("obj") => obj::load(&file, open)?,
        _ => return Err(Error::input(&file, "scenes are read from .obj files; give one, or its folder")),
    };
    scene.name = name_of(path);
    scene.files.push(file);
    scene.files.extend(draft.file().map(Path::to_owned));
    if let Some(bounds) = scene.bounds() {
        scene.camera = Some(draft.complete(bounds, &mut scene.warnings)?);
    }
    Ok(scene)
}

fn is_obj(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("obj"))
}

/// The file to read for a path that may be a folder.
fn scene_file(path: &Path) -> Result<PathBuf> {
    let found = std::fs::metadata(path).map_err(|error| match error.kind() {
        ErrorKind::NotFound => {
            let what = "there is no such scene; name a folder with a scene.obj, or an .obj file";
            Error::input(path, what)
        }
        _ => Error::io("reading the scene", path)(error),
    })?;
    if !found.is_dir() {
        return Ok(path.to_owned());
    }
    if is_obj(path) {
        return Err(Error::input(path, "this is a folder, and an OBJ file is wanted"));
    }
    let usual = path.join("scene.obj");
    if usual.exists() {
        return Ok(usual);
    }
    let reading = || Error::io("reading the folder", path);
    let mut found = Vec::new();
    for entry in std::fs::read_dir(path).map_err(reading())? {
        found.push(PathBuf::from(entry.map_err(reading())?.file_name()));
    }
    found.sort();
    let mut objs = found.iter().filter(|name| is_obj(name));
    if let (Some(only), None) = (objs.next(), objs.next()) {
        return Ok(path.join(only));
    }
    let mut list: Vec<String> = found.iter().take(12).map(|name| name.display().to_string()).collect();
    if list.is_empty() {
        list.push("nothing".to_owned());
    } else if found.len() > list.len() {
        list.push("...".to_owned());
    }
    let what =
        format!("there is no scene.obj in this folder, nor just one .obj; it holds {}", list.join(", "));
    Err(Error::input(path, what))
}

/// The folder's name, or the file's without `.obj`.
fn name_of(path: &Path) -> String {
    let whole = std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    let name = if is_obj(path) { path.file_stem() } else { path.file_name().or(whole.file_name()) };
    name.map_or_else(|| "scene".to_owned(), |n| n.to_string_lossy().into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    const OBJ: &str = "mtllib a.mtl\nusemtl lamp\nv 0 0 0\nv 1 0 0\nv 0 2 0\nf 1 2 3\n";

    fn folder(files: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a.mtl"), "newmtl lamp\nKe 1\n").unwrap();
        files.iter().for_each(|name| std::fs::write(folder.path().join(name), OBJ).unwrap());
        folder
    }

    fn message(path: &Path) -> String {
        load(path, &CameraRequest::default()).unwrap_err().to_string()
    }

    #[test]
    fn a_folder_or_a_file() {
        let both = folder(&["scene.obj", "other.OBJ"]);
        let scene = load(both.path(), &CameraRequest::default()).unwrap();
        assert_eq!(scene.name, both.path().file_name().unwrap().to_str().unwrap());
        assert_eq!(scene.bounds(), Some((Vec3::ZERO, Vec3::new(1.0, 2.0, 0.0))));
        assert_eq!(scene.files, ["a.mtl", "scene.obj"].map(|name| both.path().join(name)));
        scene.camera.unwrap().check().unwrap();
        let scene = load(&both.path().join("other.OBJ"), &CameraRequest::default()).unwrap();
        assert_eq!(scene.name, "other");
        load(folder(&["only.obj"]).path(), &CameraRequest::default()).unwrap();
    }

    #[test]
    fn nothing_to_load() {
        let two = folder(&["a.obj", "b.obj"]);
        let said = message(two.path());
        assert!(said.contains("no scene.obj") && said.contains("a.mtl, a.obj, b.obj"), "{said}");
        assert!(message(&two.path().join("c.obj")).contains("c.obj"));
        assert!(message(&two.path().join("a.mtl")).contains(".obj files"));
        std::fs::create_dir(two.path().join("scene.obj")).unwrap();
        assert!(message(two.path()).contains("scene.obj: this is not a file"));
        assert!(message(&two.path().join("scene.obj")).contains("this is a folder"));
    }

    #[test]
    fn a_camera_file_of_any_name() {
        let folder = folder(&["scene.obj"]);
        let file = folder.path().join("from above.json");
        std::fs::write(&file, r#"{"eye": [0, 9, 0], "target": [0, 0, 0], "up": [0, 0, 1]}"#).unwrap();
        let mut request = CameraRequest { file: Some(file), size: Some((8, 4)), ..Default::default() };
        let said = load(folder.path(), &request).unwrap_err().to_string();
        assert!(said.contains("from above.json: the key `vfov_deg` is missing"), "{said}");
        request.vfov_deg = Some(30.0);
        let camera = load(folder.path(), &request).unwrap().camera.unwrap();
        assert_eq!((camera.eye, camera.vfov_deg, camera.width), (Vec3::Y * 9.0, 30.0, 8));
        request.file = Some(folder.path().join("none.json"));
        assert!(load(folder.path(), &request).unwrap_err().to_string().contains("none.json"));
    }
}
