//! A scene as files: `scene.obj`, `scene.mtl`, `camera.json`.

use crate::error::{Error, Result};
use crate::output::MadeFolders;
use crate::scene::{Camera, Material, Scene};
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Vertices or triangles in one piece of text, and pieces written at a time.
const PIECE: usize = 1 << 14;
const PIECES: usize = 64;

/// Writes a scene to a folder that is empty or not there yet.
///
/// Every coordinate is written with as many digits as give back the same `f32`, and the order of
/// vertices and triangles is kept. Nothing that is half written ever bears the name of a scene file.
pub fn write(scene: &Scene, folder: &Path) -> Result<()> {
    check_empty(folder)?;
    overwrite(scene, folder)
}

/// Refuses a folder that has anything in it.
pub fn check_empty(folder: &Path) -> Result<()> {
    let occupied = match fs::read_dir(folder) {
        Ok(mut entries) => entries.next().is_some(),
        Err(error) if error.kind() == io::ErrorKind::NotFound => false,
        Err(error) if error.kind() == io::ErrorKind::NotADirectory => return Err(not_a_folder(folder)),
        Err(error) => return Err(Error::io("reading", folder)(error)),
    };
    if occupied {
        return Err(Error::input(folder, "the folder is not empty: name another one, or pass --force"));
    }
    Ok(())
}

fn not_a_folder(path: &Path) -> Error {
    Error::input(path, "this is a file, and a folder is wanted: name another one")
}

/// Like [`write()`], but replaces a scene that is there. Other files in the folder stay.
pub fn overwrite(scene: &Scene, folder: &Path) -> Result<()> {
    overwrite_unless(scene, folder, &AtomicBool::new(false)).map(drop)
}

/// Like [`overwrite`], but leaves everything as it was if `stop` is set before all is written. Was it written?
pub fn overwrite_unless(scene: &Scene, folder: &Path, stop: &AtomicBool) -> Result<bool> {
    if fs::metadata(folder).is_ok_and(|there| !there.is_dir()) {
        return Err(not_a_folder(folder));
    }
    let _made = MadeFolders::make(folder)?;
    let drafted = drafts(scene, folder, stop);
    if stop.load(Ordering::Relaxed) {
        return Ok(false);
    }
    let drafts = drafted?;
    // Or some would be replaced and others not.
    if let Some(draft) = drafts.iter().find(|draft| draft.path.is_dir()) {
        return Err(Error::input(&draft.path, "this is a folder, and a file is to be written: move it away"));
    }
    drafts.into_iter().try_for_each(Draft::publish).map(|()| true)
}

fn drafts(scene: &Scene, folder: &Path, stop: &AtomicBool) -> Result<Vec<Draft>> {
    let names = material_names(&scene.materials);
    let mut drafts = Vec::new();
    if let Some(camera) = &scene.camera {
        drafts.push(draft(folder, "camera.json", stop, |file| write_camera(camera, file))?);
    }
    drafts.push(draft(folder, "scene.mtl", stop, |file| write_materials(&scene.materials, &names, file))?);
    drafts.push(draft(folder, "scene.obj", stop, |file| write_mesh(scene, &names, file))?);
    Ok(drafts)
}

/// A file that takes nothing more once it is to stop.
struct Stoppable<'a> {
    file: File,
    stop: &'a AtomicBool,
}

impl Write for Stoppable<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(io::Error::other("it was to stop"));
        }
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// A file under a temporary name; gone when dropped, unless it was published.
struct Draft {
    temporary: PathBuf,
    path: PathBuf,
}

impl Draft {
    fn publish(self) -> Result<()> {
        fs::rename(&self.temporary, &self.path).map_err(Error::io("writing", &self.path))
    }
}

impl Drop for Draft {
    fn drop(&mut self) {
        // Once published there is nothing to remove, and that is no error.
        let _ = fs::remove_file(&self.temporary);
    }
}

fn draft(
    folder: &Path,
    name: &str,
    stop: &AtomicBool,
    fill: impl FnOnce(&mut BufWriter<Stoppable<'_>>) -> io::Result<()>,
) -> Result<Draft> {
    let path = folder.join(name);
    let temporary = folder.join(format!(".{name}.{}.tmp", std::process::id()));
    let file = File::create(&temporary).map_err(Error::io("writing", &path))?;
    let draft = Draft { temporary, path };
    let mut file = BufWriter::with_capacity(1 << 18, Stoppable { file, stop });
    fill(&mut file).and_then(|()| file.flush()).map_err(Error::io("writing", &draft.path))?;
    Ok(draft)
}

/// One word for each material: its name, or a number where that is no word or is taken.
fn material_names(materials: &[Material]) -> Vec<String> {
    let mut taken = BTreeSet::new();
    let mut names = Vec::with_capacity(materials.len());
    for (k, material) in materials.iter().enumerate() {
        let mut name = word(&material.name);
        while name.is_empty() || !taken.insert(name.clone()) {
            name = format!("{name}_{k}");
        }
        names.push(name);
    }
    names
}

fn word(name: &str) -> String {
    name.split_whitespace().collect::<Vec<_>>().join("_")
}

fn write_camera(camera: &Camera, file: &mut impl Write) -> io::Result<()> {
    serde_json::to_writer_pretty(&mut *file, camera)?;
    writeln!(file)
}

fn write_materials(materials: &[Material], names: &[String], file: &mut impl Write) -> io::Result<()> {
    for (Material { diffuse, emission, .. }, name) in materials.iter().zip(names) {
        writeln!(file, "newmtl {name}")?;
        writeln!(file, "Kd {} {} {}", diffuse.x, diffuse.y, diffuse.z)?;
        if *emission != glam::Vec3::ZERO {
            writeln!(file, "Ke {} {} {}", emission.x, emission.y, emission.z)?;
        }
    }
    Ok(())
}

fn write_mesh(scene: &Scene, names: &[String], file: &mut impl Write) -> io::Result<()> {
    writeln!(file, "mtllib scene.mtl")?;
    in_pieces(file, scene.positions.len(), |piece, text| {
        for p in &scene.positions[piece] {
            writeln!(text, "v {} {} {}", p.x, p.y, p.z)?;
        }
        Ok(())
    })?;
    in_pieces(file, scene.triangles.len(), |piece, text| {
        let mut objects = scene.objects.iter().peekable();
        while objects.next_if(|o| (o.triangles.start as usize) < piece.start).is_some() {}
        let mut material = piece.start.checked_sub(1).map(|before| scene.triangle_materials[before]);
        for t in piece {
            while let Some(object) = objects.next_if(|o| o.triangles.start as usize == t) {
                writeln!(text, "o {}", word(&object.name))?;
                material = None;
            }
            let painted = scene.triangle_materials[t];
            if material != Some(painted) {
                writeln!(text, "usemtl {}", names[painted as usize])?;
                material = Some(painted);
            }
            let [a, b, c] = scene.triangles[t].map(|i| u64::from(i) + 1);
            writeln!(text, "f {a} {b} {c}")?;
        }
        Ok(())
    })
}

/// Formats `0..len` piece by piece on all threads, and writes the pieces in order.
fn in_pieces(
    file: &mut impl Write,
    len: usize,
    format: impl Fn(std::ops::Range<usize>, &mut Vec<u8>) -> io::Result<()> + Sync,
) -> io::Result<()> {
    let mut texts: Vec<Vec<u8>> = vec![Vec::new(); PIECES];
    for batch in (0..len).step_by(PIECE * PIECES) {
        texts.par_iter_mut().enumerate().try_for_each(|(k, text)| {
            text.clear();
            let start = (batch + k * PIECE).min(len);
            format(start..(start + PIECE).min(len), text)
        })?;
        texts.iter().try_for_each(|text| file.write_all(text))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generate::{Kind, generate};
    use glam::Vec3;

    #[test]
    fn every_bit_can_be_read_back() {
        let folder = tempfile::tempdir().unwrap();
        for kind in [Kind::Forest, Kind::City] {
            let scene = generate(kind, 1, 60_000);
            overwrite(&scene, folder.path()).unwrap();
            let text = fs::read_to_string(folder.path().join("scene.obj")).unwrap();
            let (mut positions, mut triangles, mut materials, mut objects) = (vec![], vec![], vec![], vec![]);
            let mut material = "";
            for line in text.lines() {
                let (key, rest) = line.split_once(' ').unwrap();
                let numbers = || rest.split(' ').map(|n| n.parse::<f32>().unwrap());
                match key {
                    "v" => positions.push(Vec3::from_slice(&numbers().collect::<Vec<_>>())),
                    "f" => {
                        triangles
                            .push(rest.split(' ').map(|n| n.parse::<u32>().unwrap() - 1).collect::<Vec<_>>());
                        materials.push(material);
                    }
                    "usemtl" => material = rest,
                    "o" => objects.push((rest, triangles.len() as u32)),
                    _ => assert_eq!(line, "mtllib scene.mtl"),
                }
            }
            assert_eq!(positions, scene.positions);
            assert!(triangles.iter().zip(&scene.triangles).all(|(a, b)| a == b));
            assert_eq!(triangles.len(), scene.triangles.len());
            let painted = scene.triangle_materials.iter().map(|&m| scene.materials[m as usize].name.as_str());
            assert!(painted.eq(materials.iter().copied()));
            assert!(scene.objects.iter().map(|o| (o.name.as_str(), o.triangles.start)).eq(objects));

            let camera = fs::read_to_string(folder.path().join("camera.json")).unwrap();
            assert_eq!(serde_json::from_str::<Camera>(&camera).ok(), scene.camera);
            let left: Vec<_> = fs::read_dir(folder.path()).unwrap().collect();
            assert_eq!(left.len(), 3, "no temporary file stays");
        }
    }

    #[test]
    fn a_full_folder_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let scene = generate(Kind::Soup, 1, 1000);
        let inner = folder.path().join("new/soup");
        write(&scene, &inner).unwrap();
        let refusal = write(&scene, &inner).unwrap_err().to_string();
        assert!(refusal.contains("--force"), "{refusal}");
        overwrite(&scene, &inner).unwrap();

        let file = folder.path().join("file");
        fs::write(&file, "mine").unwrap();
        assert!(write(&scene, &file).is_err());
        assert!(overwrite(&scene, &file).is_err());
        assert_eq!(fs::read_to_string(&file).unwrap(), "mine");
    }

    #[test]
    fn names_become_words_of_their_own() {
        let named = |name: &str| Material { name: name.to_owned(), diffuse: Vec3::ONE, emission: Vec3::ZERO };
        let names = material_names(&["red wall", "", "red_wall", "a\nb"].map(named));
        assert_eq!(names, ["red_wall", "_1", "red_wall_2", "a_b"]);
    }
}
