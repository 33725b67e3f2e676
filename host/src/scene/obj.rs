//! Wavefront OBJ, through `tobj`.
//!
//! `tobj` gives no line numbers, lets NaN through, and gives every mesh vertices of its own. So a
//! [`Sieve`] stands between the file and `tobj`: it checks every statement, reports what is wrong
//! with its line, and hands on nothing but
//!
//! ```text
//!     v x y z n/65536 n%65536 0     the n-th vertex; its number travels as its colour
//!     f a b c ...                   vertices by absolute number
//!     o                             now and then, so that `tobj` forgets the faces it has done
//! ```
//!
//! Names and materials do not pass through: the sieve notes at which face a new run of them begins.
//! The text itself is never held, and a mesh is dropped as soon as its triangles are in the scene.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{BufRead, Read};
use std::path::{Path, PathBuf};

use glam::Vec3;

use super::lines::{Lines, is_plausible, keyword, shown, words};
use super::mtl::Library;
use super::polygon::{MAX_EARS, Splitter, is_degenerate};
use super::{Object, Scene};
use crate::accel::Accel;
use crate::error::{Error, Result};

/// How much checked text is prepared at a time.
const BATCH: usize = 1 << 16;
/// After how many corners `tobj` turns the faces so far, 24 bytes a corner, into a mesh.
const CORNERS_PER_MESH: usize = 1 << 17;

/// Reads the triangles, materials and objects of an OBJ file.
pub(super) fn load(path: &Path, file: File) -> Result<Scene> {
    let mut sieve = Sieve::new(path, file);
    let options = tobj::LoadOptions {
        single_index: false,
        triangulate: false,
        ignore_points: true,
        ignore_lines: true,
    };
    let read = tobj::load_obj_buf(&mut sieve, &options, |_| Err(tobj::LoadError::GenericFailure));
    if let Some(fault) = sieve.fault {
        return Err(fault);
    }
    let (meshes, _) = read.map_err(|e| Error::input(path, format!("tobj: {e}")))?;
    let checked = sieve.checked;
    match (checked.vertices, checked.faces) {
        (0, 0) => {
            return Err(Error::input(path, "there is no geometry in it: neither a `v` nor an `f` line"));
        }
        (n, 0) => {
            return Err(Error::input(path, format!("there are {n} vertices but no faces; add `f` lines")));
        }
        _ => {}
    }
    gather(checked, meshes)
}

/// The faces from `face` on have this name and material.
#[derive(Clone, Copy)]
struct Run {
    face: u32,
    object: u32,
    material: u32,
}

/// What the sieve knows of the file so far.
struct Checked {
    path: PathBuf,
    vertices: u32,
    faces: u32,
    corners: u64,
    corners_of_mesh: usize,
    runs: Vec<Run>,
    objects: Vec<String>, // the first is that of faces before any `o` or `g`
    material: Option<u32>,
    default_material: Option<u32>,
    library: Library,
    skipped: BTreeSet<String>,
    face: Vec<u32>,
}

/// A reader of the OBJ text that `tobj` gets. After a fault it reads as a failing file.
struct Sieve {
    lines: Lines<File>,
    checked: Checked,
    out: Vec<u8>,
    given: usize,
    fault: Option<Error>,
}

impl Sieve {
    fn new(path: &Path, file: File) -> Self {
        let checked = Checked {
            path: path.to_owned(),
            vertices: 0,
            faces: 0,
            corners: 0,
            corners_of_mesh: 0,
            runs: Vec::new(),
            objects: vec![String::new()],
            material: None,
            default_material: None,
            library: Library::default(),
            skipped: BTreeSet::new(),
            face: Vec::new(),
        };
        Self { lines: Lines::new(path, file), checked, out: Vec::new(), given: 0, fault: None }
    }

    fn refill(&mut self) -> Result<()> {
        self.out.clear();
        self.given = 0;
        while self.out.len() < BATCH {
            let Some((line, text)) = self.lines.next()? else { break };
            self.checked.statement(line, text, &mut self.out)?;
        }
        Ok(())
    }
}

impl Read for Sieve {
    fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
        let n = self.fill_buf()?.read(to)?;
        self.consume(n);
        Ok(n)
    }
}

impl BufRead for Sieve {
    fn fill_buf(&mut self) -> std::io::Result<&[u8]> {
        if self.given == self.out.len()
            && let Err(fault) = self.refill()
        {
            self.fault = Some(fault);
            return Err(std::io::Error::other("a fault that the sieve reports"));
        }
        Ok(&self.out[self.given..])
    }

    fn consume(&mut self, n: usize) {
        self.given += n;
    }
}

impl Checked {
    /// Checks a statement, and writes what `tobj` needs of it.
    fn statement(&mut self, line: u64, text: &[u8], out: &mut Vec<u8>) -> Result<()> {
        let Some((word, rest)) = keyword(text) else { return Ok(()) };
        match word {
            b"v" => self.vertex(line, rest, out),
            b"f" | b"fo" => self.face(line, rest, out),
            b"o" | b"g" => {
                self.objects.push(String::from_utf8_lossy(rest).into_owned());
                self.begin_run();
                Ok(())
            }
            b"usemtl" => self.use_material(line, rest),
            b"mtllib" => self.load_library(line, rest),
            b"vt" | b"vn" | b"s" => Ok(()),
            _ if is_plausible(word) => {
                if self.skipped.len() < 12 {
                    self.skipped.insert(shown(word));
                }
                Ok(())
            }
            _ => {
                let what = format!("`{}` is no OBJ statement; is this a text file?", shown(word));
                Err(self.fault(line, what))
            }
        }
    }

    fn fault(&self, line: u64, what: impl Into<String>) -> Error {
        Error::line(&self.path, line, what)
    }

    /// `v x y z`; a weight or colours behind it are ignored.
    fn vertex(&mut self, line: u64, rest: &[u8], out: &mut Vec<u8>) -> Result<()> {
        out.extend_from_slice(b"v ");
        let mut coordinates = words(rest);
        for k in 0..3 {
            let Some(word) = coordinates.next() else {
                return Err(self.fault(line, format!("a vertex of {k} coordinates; it needs three, v X Y Z")));
            };
            let value: Option<f32> = std::str::from_utf8(word).ok().and_then(|w| w.parse().ok());
            let what = match value {
                Some(v) if v.abs() <= super::MAX_COORDINATE => {
                    out.extend_from_slice(word);
                    out.push(b' ');
                    continue;
                }
                // Any word of digits that overflows is an infinity by now.
                Some(v) if !v.is_nan() && word.iter().any(u8::is_ascii_digit) => {
                    format!("is beyond {:e}; scale the scene down, or move it", super::MAX_COORDINATE)
                }
                Some(_) => "is not finite; write a number".to_owned(),
                None => "is not a number; write three numbers, v X Y Z".to_owned(),
            };
            return Err(self.fault(line, format!("the vertex coordinate `{}` {what}", shown(word))));
        }
        push_number(out, self.vertices >> 16);
        push_number(out, self.vertices & 0xffff);
        out.extend_from_slice(b"0\n");
        self.vertices = match self.vertices.checked_add(1) {
            Some(n) if n < u32::MAX => n,
            _ => return Err(self.fault(line, "more vertices than 32 bits can count; split the file")),
        };
        Ok(())
    }

    /// `f a b c ...`; what follows a slash is ignored.
    fn face(&mut self, line: u64, rest: &[u8], out: &mut Vec<u8>) -> Result<()> {
        let mut face = std::mem::take(&mut self.face);
        face.clear();
        for word in words(rest) {
            let vertex = resolve(word, self.vertices).map_err(|what| self.fault(line, what))?;
            face.push(vertex);
        }
        if face.len() < 3 {
            let what = format!("a face of {} vertices; it needs three or more, f A B C", face.len());
            return Err(self.fault(line, what));
        }
        if self.material.is_none() && self.default_material.is_none() {
            self.default_material = Some(self.library.add_default());
            self.begin_run();
        }
        if self.corners_of_mesh >= CORNERS_PER_MESH {
            out.extend_from_slice(b"o\n");
            self.corners_of_mesh = 0;
        }
        out.extend_from_slice(b"f ");
        face.iter().for_each(|&v| push_number(out, v + 1));
        out.push(b'\n');

        self.corners += face.len() as u64;
        self.corners_of_mesh += face.len();
        self.faces += 1;
        if self.corners - 2 * u64::from(self.faces) > Accel::MOST_TRIANGLES as u64 {
            let most = Accel::MOST_TRIANGLES;
            return Err(self.fault(line, format!("more than {most} triangles; split the file")));
        }
        self.face = face;
        Ok(())
    }

    /// From the next face on, the object or the material is another one.
    fn begin_run(&mut self) {
        let material = self.material.or(self.default_material);
        let run = Run {
            face: self.faces,
            object: self.objects.len() as u32 - 1,
            // A face decides whether the default is needed at all.
            material: material.unwrap_or(u32::MAX),
        };
        match self.runs.last_mut() {
            Some(last) if last.face == run.face => *last = run,
            _ => self.runs.push(run),
        }
    }

    fn use_material(&mut self, line: u64, name: &[u8]) -> Result<()> {
        if name.is_empty() {
            return Err(self.fault(line, "usemtl without a name; add the name of a material"));
        }
        if let Some(material) = self.library.find(name) {
            self.material = Some(material);
            self.begin_run();
            return Ok(());
        }
        let name = shown(name);
        let files = self.library.file_names();
        let what = if files.is_empty() {
            format!("usemtl {name}, but no mtllib line above says where materials are; add mtllib FILE.mtl")
        } else if self.library.is_empty() {
            format!("material `{name}` is not defined: there is no newmtl in {files}")
        } else {
            let names = self.library.some_names();
            format!(
                "material `{name}` is not defined in {files} (which has {names}); add it or mend the name"
            )
        };
        Err(self.fault(line, what))
    }

    /// `mtllib my materials.mtl` is one file if there is one of that name, and two if not.
    fn load_library(&mut self, line: u64, rest: &[u8]) -> Result<()> {
        if rest.is_empty() {
            return Err(self.fault(line, "mtllib without a file; add its name"));
        }
        let folder = self.path.parent().unwrap_or(Path::new("")).to_owned();
        let whole = existing(&folder, rest);
        let names = if whole.is_some() { vec![rest] } else { words(rest).collect::<Vec<_>>() };
        let some_exist = names.iter().any(|name| existing(&folder, name).is_some());
        for name in names {
            let Some(path) = existing(&folder, name) else {
                let name = shown(if some_exist { name } else { rest });
                let what =
                    format!("mtllib {name}: there is no such file beside the OBJ; add it or mend the name");
                return Err(self.fault(line, what));
            };
            let opened = File::open(&path).and_then(|file| Ok((file.metadata()?.is_file(), file)));
            let file = match opened {
                Ok((true, file)) => file,
                Ok((false, _)) => {
                    return Err(self.fault(line, format!("mtllib {}: this is not a file", shown(name))));
                }
                Err(e) => return Err(self.fault(line, format!("mtllib {}: {e}", shown(name)))),
            };
            self.library.load(&path, file)?;
        }
        Ok(())
    }
}

/// Whether and where a file exists that an OBJ names, also with the separators of Windows.
fn existing(folder: &Path, name: &[u8]) -> Option<PathBuf> {
    let slashes: Vec<u8> = name.iter().map(|&b| if b == b'\\' { b'/' } else { b }).collect();
    let candidates = [folder.join(as_path(name)), folder.join(as_path(&slashes))];
    candidates.into_iter().find(|p| p.exists())
}

#[cfg(unix)]
fn as_path(name: &[u8]) -> PathBuf {
    use std::os::unix::ffi::OsStrExt;
    std::ffi::OsStr::from_bytes(name).into()
}

#[cfg(not(unix))]
fn as_path(name: &[u8]) -> PathBuf {
    String::from_utf8_lossy(name).into_owned().into()
}

/// The vertex that a face names, counted from 0: `7`, `-1`, `7/3`, `7/3/9`, `7//9`.
fn resolve(word: &[u8], vertices: u32) -> std::result::Result<u32, String> {
    let number = word.split(|&b| b == b'/').next().unwrap_or(word);
    let (is_negative, digits) = match number {
        [b'-', digits @ ..] => (true, digits),
        [b'+', digits @ ..] => (false, digits),
        digits => (false, digits),
    };
    if digits.is_empty() || !digits.iter().all(u8::is_ascii_digit) {
        return Err(format!("the face vertex `{}` is not a whole number", shown(word)));
    }
    // Saturating keeps whatever does not fit out of range.
    let value = digits.iter().fold(0u64, |n, d| n.saturating_mul(10).saturating_add(u64::from(d - b'0')));
    let above = u64::from(vertices);
    match (value, is_negative) {
        (0, _) => Err("the face vertex 0; vertices are counted from 1".to_owned()),
        (n, false) if n <= above => Ok((n - 1) as u32),
        (n, true) if n <= above => Ok((above - n) as u32),
        _ => {
            let what = "does not exist: there are";
            Err(format!("the face vertex {} {what} {vertices} `v` lines above this line", shown(number)))
        }
    }
}

/// Appends a number and a blank.
fn push_number(out: &mut Vec<u8>, mut n: u32) {
    let mut digits = [b' '; 11];
    let mut at = 10;
    loop {
        at -= 1;
        digits[at] = b'0' + (n % 10) as u8;
        n /= 10;
        if n == 0 {
            break;
        }
    }
    out.extend_from_slice(&digits[at..]);
}

/// One array of vertices and one of triangles, from the meshes of `tobj`.
fn gather(mut checked: Checked, meshes: Vec<tobj::Model>) -> Result<Scene> {
    let most = checked.corners - 2 * u64::from(checked.faces);
    let mut scene = Scene {
        triangles: Vec::with_capacity(most as usize),
        triangle_materials: Vec::with_capacity(most as usize),
        ..Scene::default()
    };
    let mut places = vec![u32::MAX; checked.vertices as usize]; // of the file's vertices in the scene
    let mut splitter = Splitter::default();
    let mut degenerate = 0u64;
    let mut guessed = 0u64;
    let mut of_object = None;
    let mut runs = std::mem::take(&mut checked.runs).into_iter().peekable();
    let mut run = Run { face: 0, object: 0, material: u32::MAX };
    let mut faces = 0;

    for tobj::Model { mesh, .. } in meshes {
        let position = |i: u32| {
            let at = 3 * i as usize;
            Vec3::from_slice(&mesh.positions[at..at + 3])
        };
        let number = |i: u32| {
            let at = 3 * i as usize;
            mesh.vertex_color[at] as usize * 0x1_0000 + mesh.vertex_color[at + 1] as usize
        };
        let mut arities = mesh.face_arities.iter();
        let mut rest = &mesh.indices[..];
        while !rest.is_empty() {
            let corners;
            (corners, rest) = rest.split_at(arities.next().map_or(3, |&n| n as usize));
            while let Some(next) = runs.next_if(|r| r.face <= faces) {
                run = next;
            }
            faces += 1;

            let one = [[0, 1, 2]];
            let triangles = if corners.len() == 3 {
                &one[..]
            } else {
                let split = splitter.split(corners.iter().map(|&i| position(i)));
                guessed += u64::from(split.is_guess);
                degenerate += (corners.len() - 2 - split.triangles.len()) as u64;
                split.triangles
            };
            for triangle in triangles {
                let triangle = triangle.map(|k| corners[k as usize]);
                if is_degenerate(triangle.map(position)) {
                    degenerate += 1;
                    continue;
                }
                let end = scene.triangles.len() as u32;
                if of_object != Some(run.object) {
                    of_object = Some(run.object);
                    let name = std::mem::take(&mut checked.objects[run.object as usize]);
                    scene.objects.push(Object { name, triangles: end..end });
                }
                scene.triangles.push(triangle.map(|i| {
                    let place = &mut places[number(i)];
                    if *place == u32::MAX {
                        *place = scene.positions.len() as u32;
                        scene.positions.push(position(i));
                    }
                    *place
                }));
                scene.triangle_materials.push(run.material);
                if let Some(object) = scene.objects.last_mut() {
                    object.triangles.end = end + 1;
                }
            }
        }
    }
    finish(checked, scene, degenerate, guessed)
}

/// Adds materials and warnings; refuses a scene without area or light.
fn finish(mut checked: Checked, mut scene: Scene, degenerate: u64, guessed: u64) -> Result<Scene> {
    let path = &checked.path;
    if scene.triangles.is_empty() {
        let what = "no triangle with an area: the corners of every face lie in one line or point";
        return Err(Error::input(path, what));
    }
    if let Some((lo, hi)) = scene.bounds()
        && let extent = (hi - lo).max_element()
        && extent < super::MIN_EXTENT
    {
        let least = super::MIN_EXTENT;
        let what = format!("the scene is {extent:e} across, which is below {least:e}; scale it up");
        return Err(Error::input(path, what));
    }
    scene.triangles.shrink_to_fit();
    scene.triangle_materials.shrink_to_fit();
    scene.positions.shrink_to_fit();
    scene.warnings.extend(checked.library.warnings());
    let emits = checked.library.has_light();
    let files = checked.library.file_names();
    scene.materials = std::mem::take(&mut checked.library.materials);
    scene.files = checked.library.files().to_vec();
    if !scene.has_light() {
        let mend = match files.as_str() {
            "" => "name a material file with mtllib and give one of its materials a Ke line".to_owned(),
            files => format!("add a Ke line to {files}"),
        };
        let mut what = format!("no face has a material with Ke > 0, so nothing gives light; {mend}");
        if emits {
            what = "nothing gives light: the materials with Ke > 0 are on no face, or only on faces without area; \
                    use one of them for a face"
                .to_owned();
        }
        let notes: String = scene.warnings.iter().map(|w| format!(" (note: {w})")).collect();
        return Err(Error::input(path, what + &notes));
    }

    let mut warn = |what: String| scene.warnings.push(format!("{}: {what}", path.display()));
    if checked.default_material.is_some() {
        warn("the faces before the first usemtl are grey (Kd 0.5)".to_owned());
    }
    if !checked.skipped.is_empty() {
        let kinds: Vec<&str> = checked.skipped.iter().map(String::as_str).collect();
        warn(format!("ignored the statements {}", kinds.join(", ")));
    }
    if degenerate > 0 {
        warn(format!("left out {degenerate} triangles without area"));
    }
    if guessed > 0 {
        warn(format!(
            "split {guessed} polygons from their first vertex though that may cover more than the polygon: \
             they cross themselves, or are dented and have over {MAX_EARS} vertices"
        ));
    }
    Ok(scene)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MTL: &str = "newmtl lamp\nKe 1\nnewmtl my box\nKd 0.25\n";
    const CORNERS: &str = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nusemtl lamp\n";

    fn load(obj: impl AsRef<[u8]>) -> Result<Scene> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a.mtl"), MTL).unwrap();
        std::fs::write(folder.path().join("b c.mtl"), "newmtl b\n").unwrap();
        std::fs::create_dir(folder.path().join("folder.mtl")).unwrap();
        let path = folder.path().join("a.obj");
        std::fs::write(&path, obj).unwrap();
        super::load(&path, File::open(&path).unwrap())
    }

    /// The scene of a few statements behind four corners of a square and `usemtl lamp`: line 7 on.
    fn square(statements: &str) -> Result<Scene> {
        load(CORNERS.to_owned() + statements)
    }

    #[track_caller]
    fn assert_fault(read: Result<Scene>, line: u64, what: &str) {
        let message = read.unwrap_err().to_string();
        let place = if line == 0 { "a.obj: ".to_owned() } else { format!("a.obj:{line}: ") };
        assert!(message.contains(&place) && message.contains(what), "{message}");
    }

    #[test]
    fn indices_and_slashes() {
        for face in [
            "f 1 2 3",
            "f -4 -3 -2",
            "f 1/7 2/8/9 3//1",
            " f\t+1  02 3 # of three",
            "f 1 \\\n2 \\\r\n3",
            "f 1/x 2/ 3//",
        ] {
            let scene = square(face).unwrap();
            assert_eq!(scene.triangles, [[0, 1, 2]], "{face}");
            assert_eq!(scene.vertices(0), [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0)]);
            assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
        }
    }

    #[test]
    fn vertices_are_shared_and_only_those_in_use_are_kept() {
        let scene = square("v 9 9 9\no a\nf 1 2 3\nusemtl my box\no b\nf 1 3 4\n").unwrap();
        assert_eq!(scene.positions.len(), 4);
        assert_eq!(scene.triangles, [[0, 1, 2], [0, 2, 3]]);
    }

    #[test]
    fn faults_name_the_line() {
        for (statement, what) in [
            ("v 1 2", "2 coordinates"),
            ("v", "0 coordinates"),
            ("v 1 nan 2", "`nan` is not finite"),
            ("v 1 -inf 2", "`-inf` is not finite"),
            ("v 1 -1.1e8 2", "beyond 1e8; scale the scene down"),
            ("v 1 1e400 2", "beyond 1e8; scale the scene down"),
            ("v 1 two 3", "`two` is not a number"),
            ("v 1 2 3,5", "`3,5` is not a number"),
            ("f 1 2", "a face of 2"),
            ("f 1 2 # 3", "a face of 2"),
            ("f", "a face of 0"),
            ("f 1 2 0", "counted from 1"),
            ("f 1 2 5", "there are 4"),
            ("f 1 2 -5", "there are 4"),
            ("f 1 2 99999999999999999999", "there are 4"),
            ("f 1 2 -99999999999999999999", "there are 4"),
            ("f 1 2 3.5", "not a whole number"),
            ("f 1 2 /3", "not a whole number"),
            ("f 1 2 -", "not a whole number"),
            ("usemtl box", "`box` is not defined in a.mtl (which has lamp, my box)"),
            ("usemtl", "without a name"),
            ("mtllib", "without a file"),
            ("mtllib none at all.mtl", "mtllib none at all.mtl: "),
            ("mtllib a.mtl none.mtl", "mtllib none.mtl: "),
            ("mtllib folder.mtl", "folder.mtl: this is not a file"),
            ("o a\0b", "NUL"),
            ("\u{1}\u{2} 1", "no OBJ statement"),
        ] {
            assert_fault(square(&format!("{statement}\nf 1 2 3\n")), 7, what);
            assert_fault(square(statement), 7, what);
        }
        assert_fault(square("f 1 2 \\\n3 \\\n9\nf 1 2 3"), 7, "the face vertex 9");
        assert_fault(load("usemtl lamp\nf 1 2 3"), 1, "no mtllib");
        assert_fault(load("f 1 2 3\nv 0 0 0\nv 1 0 0\nv 0 1 0"), 1, "there are 0");
    }

    #[test]
    fn nothing_to_see() {
        assert_fault(load(""), 0, "no geometry");
        assert_fault(load("# nothing\n\n"), 0, "no geometry");
        assert_fault(square(""), 0, "no faces");
        assert_fault(square("f 1 1 2\nf 1 2 2 1"), 0, "no triangle with an area");
        assert_fault(square("usemtl my box\nf 1 2 3"), 0, "nothing gives light");
        assert_fault(square("f 1 2 2\nusemtl my box\nf 1 2 3"), 0, "nothing gives light");
        assert_fault(load("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3"), 0, "mtllib");
    }

    #[test]
    fn scenes_may_be_large_or_small_but_not_anything() {
        let corners = |size: f32| {
            let [x, y] = [format!("v {size} 0 0\n"), format!("v 0 {} 0\n", -0.5 * size)];
            load(format!("mtllib a.mtl\nv 0 0 0\n{x}{y}usemtl lamp\nf 1 2 3"))
        };
        corners(1e8).unwrap();
        corners(1e-8).unwrap();
        assert_fault(corners(0.9e-8), 0, "9e-9 across, which is below 1e-8; scale it up");
        assert_fault(corners(1.1e8), 3, "beyond 1e8; scale the scene down");
    }

    #[test]
    fn objects_cover_the_triangles_in_order() {
        let scene = load(
            &b"mtllib b c.mtl\nmtllib .\\a.mtl a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n\
               f 1 2 3\no empty\no caf\xe9 au lait\nusemtl my box\nf 1 2 3 4\nusemtl lamp\nf 1 2 2\nf 2 3 4\n\
               g\nusemtl my box\nf 1 2 4"[..],
        )
        .unwrap();
        let objects: Vec<_> = scene.objects.iter().map(|o| (o.name.as_str(), o.triangles.clone())).collect();
        assert_eq!(objects, [("", 0..1), ("caf\u{fffd} au lait", 1..4), ("", 4..5)]);
        let materials: Vec<&str> = (0..5).map(|t| scene.material(t).name.as_str()).collect();
        assert_eq!(materials, ["(no material)", "my box", "my box", "lamp", "my box"]);
        assert_eq!(scene.material(0).diffuse, Vec3::splat(0.5));
        assert_eq!(scene.warnings.len(), 2, "{:?}", scene.warnings);
    }

    #[test]
    fn numbers_of_vertices_and_runs_survive_many_meshes() {
        let n = 100_000u32;
        let mut obj = String::from("mtllib a.mtl\nusemtl lamp\n");
        for i in 0..n {
            obj += &format!("v {i} 0 1 0.5 0.5 0.5\nv {i} 1 0 2.0\nv 0 0 {i}.5\n");
        }
        for i in 0..n {
            let name = if i % 3 == 0 { "lamp" } else { "my box" };
            obj += &format!("usemtl {name}\no {i}\nf {} {} -1\n", 3 * i + 1, 3 * i + 2);
        }
        let scene = load(obj).unwrap();
        assert_eq!((scene.triangles.len(), scene.objects.len()), (n as usize, n as usize));
        for i in 0..n {
            let x = i as f32;
            let corners =
                [Vec3::new(x, 0.0, 1.0), Vec3::new(x, 1.0, 0.0), Vec3::new(0.0, 0.0, n as f32 - 0.5)];
            assert_eq!(scene.vertices(i), corners);
            assert_eq!(scene.material(i).name == "lamp", i % 3 == 0);
            assert_eq!(scene.objects[i as usize].name, i.to_string());
        }
    }

    #[test]
    fn odd_but_usable() {
        let scene = square("p 1\nl 1 2\ncurv 0 1\ns off\nvt 0 nan\nf 1 3 2 4\nf 1 1 2 3\n").unwrap();
        assert_eq!(scene.warnings.len(), 3, "{:?}", scene.warnings);
        assert!(scene.warnings[0].contains("curv, l, p"));
        assert!(scene.warnings[1].contains("1 triangles without area"));
        assert!(scene.warnings[2].contains("1 polygons"));
    }
}
