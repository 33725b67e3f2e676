//! Material libraries (.mtl): `Kd` and `Ke` of every material.

use std::collections::{BTreeSet, HashMap};
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use glam::Vec3;

use super::Material;
use super::lines::{Lines, is_plausible, keyword, shown, words};
use crate::error::{Error, Result};

/// The largest radiance or reflectance: products of two still fit an `f32`.
const MAX_COLOUR: f32 = 1e18;

/// What a surface reflects if no file says so.
pub(super) const DEFAULT_GREY: Vec3 = Vec3::splat(0.5);

/// Statements that say what this renderer has no part in: highlights, refraction, other models of light.
const OF_OTHERS: &str = "Ka Ks Km Ns Ni Tf Tr d illum sharpness Pr Pm Ps Pc Pcr aniso anisor";

/// The materials of all libraries that an OBJ names.
///
/// The last definition of a name counts. Without `Kd` a material is grey, [`DEFAULT_GREY`], or black
/// if it has a `Ke` above zero: who describes a lamp by its light alone means nothing but a lamp.
#[derive(Default)]
pub(super) struct Library {
    pub(super) materials: Vec<Material>,
    names: HashMap<Vec<u8>, u32>, // bytes, as the file may be in any encoding
    files: Vec<PathBuf>,
    duplicates: Vec<String>,
    bright: Vec<String>,
    ignored: BTreeSet<String>,
    unknown: BTreeSet<String>,
}

impl Library {
    /// Adds the materials of a file, unless that was done before.
    pub(super) fn load(&mut self, path: &Path, file: File) -> Result<()> {
        if self.files.iter().any(|p| p == path) {
            return Ok(());
        }
        self.files.push(path.to_owned());

        let mut text = Vec::new(); // what tobj gets: numbers that were checked, and names it cannot misread
        let mut names = Vec::new();
        let mut lines = Lines::new(path, file);
        while let Some((line, statement)) = lines.next()? {
            let Some((word, rest)) = keyword(statement) else { continue };
            match word {
                b"newmtl" if rest.is_empty() => {
                    return Err(Error::line(path, line, "newmtl without a name; add one"));
                }
                b"newmtl" => {
                    writeln!(text, "newmtl {}", names.len()).expect("memory takes all");
                    names.push(rest.to_owned());
                }
                b"Kd" | b"Ke" => {
                    let key = if word == b"Kd" { "Kd" } else { "Ke" };
                    let [r, g, b] = colour(key, rest).map_err(|what| Error::line(path, line, what))?;
                    if names.is_empty() {
                        let what = format!("{key} before any newmtl; begin the material with newmtl NAME");
                        return Err(Error::line(path, line, what));
                    }
                    writeln!(text, "{key} {r} {g} {b}").expect("memory takes all");
                }
                _ if is_plausible(word) => self.note_ignored(word, rest),
                _ => {
                    let what = format!("`{}` is no MTL statement; is this a text file?", shown(word));
                    return Err(Error::line(path, line, what));
                }
            }
        }
        let (read, _) = tobj::load_mtl_buf(&mut &text[..]).map_err(|e| Error::input(path, e.to_string()))?;
        if read.len() != names.len() {
            return Err(Error::input(path, "the materials could not be told apart"));
        }
        for (material, name) in read.into_iter().zip(names) {
            self.add(name, material.diffuse.map(Vec3::from), material.emissive.map(Vec3::from));
        }
        Ok(())
    }

    fn add(&mut self, name: Vec<u8>, diffuse: Option<Vec3>, emission: Option<Vec3>) {
        let emission = emission.unwrap_or(Vec3::ZERO);
        let without = if emission == Vec3::ZERO { DEFAULT_GREY } else { Vec3::ZERO };
        let diffuse = diffuse.unwrap_or(without);
        let shown = String::from_utf8_lossy(&name).into_owned();
        if diffuse.max_element() > 1.0 {
            self.bright.push(shown.clone());
        }
        let index = self.materials.len() as u32;
        self.materials.push(Material { name: shown.clone(), diffuse, emission });
        if self.names.insert(name, index).is_some() {
            self.duplicates.push(shown);
        }
    }

    /// The number of the grey of faces that have no material.
    pub(super) fn add_default(&mut self) -> u32 {
        let name = "(no material)".to_owned();
        self.materials.push(Material { name, diffuse: DEFAULT_GREY, emission: Vec3::ZERO });
        self.materials.len() as u32 - 1
    }

    pub(super) fn find(&self, name: &[u8]) -> Option<u32> {
        self.names.get(name).copied()
    }

    /// Whether a material that a face could have emits.
    pub(super) fn has_light(&self) -> bool {
        self.names.values().any(|&m| self.materials[m as usize].emission != Vec3::ZERO)
    }

    /// The files read.
    pub(super) fn files(&self) -> &[PathBuf] {
        &self.files
    }

    /// The files read, by name.
    pub(super) fn file_names(&self) -> String {
        let name = |p: &PathBuf| p.file_name().unwrap_or(p.as_os_str()).to_string_lossy().into_owned();
        self.files.iter().map(name).collect::<Vec<_>>().join(", ")
    }

    /// A few of the names that can be used, for a message about one that cannot.
    pub(super) fn some_names(&self) -> String {
        let some: Vec<&str> = self.materials.iter().take(6).map(|m| m.name.as_str()).collect();
        let more = if self.materials.len() > some.len() { ", ..." } else { "" };
        some.join(", ") + more
    }

    pub(super) fn is_empty(&self) -> bool {
        self.materials.is_empty()
    }

    /// Remembers a statement that would change the picture if it were heeded, and one that nobody knows.
    fn note_ignored(&mut self, word: &[u8], rest: &[u8]) {
        let is_texture =
            word.starts_with(b"map_") || [&b"bump"[..], b"disp", b"decal", b"refl", b"norm"].contains(&word);
        let value = words(rest).next().and_then(number);
        let is_see_through = match word {
            b"d" => value.is_some_and(|v| v < 1.0),
            b"Tr" => value.is_some_and(|v| v > 0.0),
            _ => false,
        };
        if is_texture || is_see_through {
            note(&mut self.ignored, word);
        } else if !OF_OTHERS.split(' ').any(|known| known.as_bytes() == word) {
            note(&mut self.unknown, word);
        }
    }

    /// Sentences about what was odd.
    pub(super) fn warnings(&self) -> impl Iterator<Item = String> {
        let duplicates = (!self.duplicates.is_empty()).then(|| {
            let what = "is defined more than once; the last definition counts";
            format!("material {} {what}", first_of(&self.duplicates))
        });
        let bright = (!self.bright.is_empty()).then(|| {
            let what = "reflects more light than it gets (Kd above 1); it is used as it is";
            format!("material {} {what}", first_of(&self.bright))
        });
        let ignored = (!self.ignored.is_empty()).then(|| {
            let kinds: Vec<&str> = self.ignored.iter().map(String::as_str).collect();
            format!("textures and transparency are ignored ({} in {})", kinds.join(", "), self.file_names())
        });
        let unknown = (!self.unknown.is_empty()).then(|| {
            let kinds: Vec<&str> = self.unknown.iter().map(String::as_str).collect();
            format!("ignored the statements {} in {}", kinds.join(", "), self.file_names())
        });
        [duplicates, bright, ignored, unknown].into_iter().flatten()
    }
}

/// Keeps a few words for a message.
fn note(words: &mut BTreeSet<String>, word: &[u8]) {
    if words.len() < 12 {
        words.insert(shown(word));
    }
}

/// The first of some names, and how many more there are.
fn first_of(names: &[String]) -> String {
    match names.len() - 1 {
        0 => format!("`{}`", shown(names[0].as_bytes())),
        more => format!("`{}` (and {more} more)", shown(names[0].as_bytes())),
    }
}

fn number(word: &[u8]) -> Option<f32> {
    std::str::from_utf8(word).ok()?.parse().ok()
}

/// The three channels of `Kd` or `Ke`; one number is a grey.
fn colour(key: &str, rest: &[u8]) -> std::result::Result<[f32; 3], String> {
    let mut channels = [0.0; 3];
    let mut count = 0;
    for word in words(rest) {
        if count == 0 && (word == b"spectral" || word == b"xyz") {
            return Err(format!("{key} {} is not supported; write {key} R G B", shown(word)));
        }
        let value = number(word).filter(|v| v.is_finite());
        let value = value
            .ok_or_else(|| format!("{key}: `{}` is not a finite number; write {key} R G B", shown(word)))?;
        if !(0.0..=MAX_COLOUR).contains(&value) {
            return Err(format!("{key}: `{}` must lie between 0 and {MAX_COLOUR:e}", shown(word)));
        }
        if count < 3 {
            channels[count] = value;
        }
        count += 1;
    }
    match count {
        1 => Ok([channels[0]; 3]),
        3 => Ok(channels),
        _ => Err(format!("{key} has {count} numbers; write three, {key} R G B")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(text: &[u8]) -> Result<Library> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mtl");
        std::fs::write(&path, text).unwrap();
        let mut library = Library::default();
        library.load(&path, File::open(&path).unwrap())?;
        library.load(&path, File::open(&path).unwrap())?;
        Ok(library)
    }

    #[test]
    fn colours_and_defaults() {
        let library = load(
            b"# of our own\r\n newmtl my box \r\nKd .25\nKe 0 0 0 # none\nillum 2\n\
              newmtl bo\xeete\nnewmtl lamp\nKe 3 2 1\nnewmtl glow\nKd 0.5 0.25 0\n\tKe 1e18",
        )
        .unwrap();
        let material = |name: &[u8]| {
            let m = &library.materials[library.find(name).unwrap() as usize];
            (m.diffuse.to_array(), m.emission.to_array())
        };
        assert_eq!(library.materials.len(), 4);
        assert_eq!(material(b"my box"), ([0.25; 3], [0.0; 3]));
        assert_eq!(material(b"bo\xeete"), ([0.5; 3], [0.0; 3]));
        assert_eq!(material(b"lamp"), ([0.0; 3], [3.0, 2.0, 1.0]));
        assert_eq!(material(b"glow"), ([0.5, 0.25, 0.0], [1e18; 3]));
        assert_eq!(library.find(b"box"), None);
        assert_eq!(library.warnings().count(), 0);
    }

    #[test]
    fn faults_name_the_line() {
        for statement in [
            "Kd 1 red 1",
            "Kd 1 1",
            "Kd",
            "Kd 1 1 1 1",
            "Kd -0.5 0 0",
            "Ke -1",
            "Ke nan 1 1",
            "Ke inf",
            "Ke 2e18",
            "Kd spectral a.rfl",
            "Ke xyz 1 1 1",
            "newmtl",
            "newmtl  ",
            "\x01\x02 3",
        ] {
            let text = format!("newmtl a\nKd 1 1 1\n{statement}\nnewmtl b");
            let message = load(text.as_bytes()).err().expect(statement).to_string();
            assert!(message.contains("a.mtl:3: "), "{statement}: {message}");
        }
        assert!(load(b"Kd 1 1 1").err().unwrap().to_string().contains("a.mtl:1: "));
    }

    #[test]
    fn odd_but_usable() {
        let library = load(
            b"newmtl a\nKd 5\nmap_Kd a.png\nd 0.5\nnewmtl a\nKd 0.125\nd 1\nkd 1\nbump a.png\nmtllib a.mtl",
        )
        .unwrap();
        assert_eq!(library.materials[library.find(b"a").unwrap() as usize].diffuse, Vec3::splat(0.125));
        let warnings: Vec<String> = library.warnings().collect();
        assert_eq!(warnings.len(), 4, "{warnings:?}");
        assert!(warnings[2].contains("bump, d, map_Kd"), "{warnings:?}");
        assert!(warnings[3].contains("ignored the statements kd, mtllib in a.mtl"), "{warnings:?}");
    }
}
