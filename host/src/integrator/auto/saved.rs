//! What a map has learned, as a file.
//!
//! ```text
//! 8 bytes   "occlmap" and a line feed
//! u32       0x01020304, which tells the order of bytes
//! u32       the version, 2
//! u64       the hash of the triangles and lights it belongs to
//! u64       cells
//! u32, u32  passes; shadow rays of a camera sample
//! 16 × u64  rays by class of doubt, and as many: how far guesses were off
//! 72 × 2 × u64   by kind of pixel, how far samples were apart, and how many
//! of each cell
//!     u64       its key
//!     9 × f32   its normal and bounds
//!     u32       how often it is asked
//!     64 × 2 × u32   rays to each bin of its light, and those that were free
//! u64       the hash of all of this
//! ```
//!
//! Numbers have their lowest byte first. What is proven is not in it: a map proves it again.

use super::kinds::{KINDS, Seen};
use crate::error::{Error, Result};
use crate::integrator::Stage;
use crate::light::Shape;
use crate::output;
use occlude_kernel::occlusion_map::{BINS, CLASSES, CellKey, Doubts, MapCell, Tally};
use std::path::Path;

const MAGIC: &[u8; 8] = b"occlmap\n";
const ORDER: u32 = 0x0102_0304;
const VERSION: u32 = 2;
const HEAD: usize = 8 + 4 + 4 + 8 + 8 + 4 + 4 + 2 * CLASSES * 8 + 2 * KINDS * 8;
const EACH: usize = 8 + 9 * 4 + 4 + BINS * 8;

/// What a map has learned.
#[derive(Clone, Debug)]
pub struct SavedMap {
    /// The hash of the triangles and lights it belongs to: [`fingerprint`].
    pub belongs_to: u64,
    /// Passes it has learned from.
    pub passes: u32,
    /// Shadow rays of a camera sample in these.
    pub shadow_rays: u32,
    /// How far guesses were off.
    pub doubts: Doubts,
    pub(super) kinds: Seen,
    pub(super) cells: Vec<SavedCell>,
}

#[derive(Clone, Debug)]
pub(super) struct SavedCell {
    pub(super) cell: MapCell,
    pub(super) points: u32,
    pub(super) tallies: [Tally; BINS],
}

/// A hash of what decides visibility: the triangles, and where the lights are.
pub fn fingerprint(stage: &Stage<'_>) -> u64 {
    let mut hash = Hash::default();
    let scene = stage.scene;
    for k in 0..scene.triangles.len() as u32 {
        scene
            .vertices(k)
            .iter()
            .for_each(|vertex| vertex.to_array().iter().for_each(|at| hash.add(at.to_bits())));
    }
    for light in stage.lights {
        let shape = if light.shape == Shape::Triangle { 3 } else { 4 };
        hash.add(shape);
        for at in [light.corner, light.u, light.v, light.normal] {
            at.to_array().iter().for_each(|at| hash.add(at.to_bits()));
        }
    }
    hash.end()
}

/// A word at a time, each mixed into all bits.
struct Hash(u64, u64);

impl Default for Hash {
    fn default() -> Self {
        Self(0x9e37_79b9_7f4a_7c15, 0)
    }
}

impl Hash {
    fn add(&mut self, word: u32) {
        self.0 = (self.0 ^ u64::from(word)).wrapping_mul(0xff51_afd7_ed55_8ccd);
        self.0 ^= self.0 >> 32;
        self.1 += 1;
    }

    fn end(mut self) -> u64 {
        let count = self.1;
        self.add(count as u32);
        self.add((count >> 32) as u32);
        self.0
    }

    fn of(bytes: &[u8]) -> u64 {
        let mut hash = Self::default();
        let words = bytes.chunks_exact(4);
        let rest = words.remainder();
        words.for_each(|word| hash.add(u32::from_le_bytes([word[0], word[1], word[2], word[3]])));
        rest.iter().for_each(|&byte| hash.add(byte.into()));
        hash.end()
    }
}

/// Bytes, from the front.
struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        // Lengths are checked before.
        let (first, rest) = self.0.split_at(N);
        self.0 = rest;
        first.try_into().expect("N bytes")
    }

    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }

    fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.take())
    }

    fn three(&mut self) -> [f32; 3] {
        std::array::from_fn(|_| f32::from_bits(self.u32()))
    }
}

impl SavedMap {
    /// Cells.
    pub fn cells(&self) -> usize {
        self.cells.len()
    }

    /// As a file holds it.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEAD + self.cells.len() * EACH + 8);
        bytes.extend(MAGIC);
        bytes.extend([ORDER, VERSION].iter().flat_map(|word| word.to_le_bytes()));
        bytes.extend([self.belongs_to, self.cells.len() as u64].iter().flat_map(|word| word.to_le_bytes()));
        bytes.extend([self.passes, self.shadow_rays].iter().flat_map(|word| word.to_le_bytes()));
        let counts = self.doubts.asked.iter().chain(&self.doubts.squared);
        bytes.extend(counts.flat_map(|word| word.to_le_bytes()));
        bytes.extend(self.kinds.0.iter().flatten().flat_map(|word| word.to_le_bytes()));
        for SavedCell { cell, points, tallies } in &self.cells {
            bytes.extend(cell.key().bits().to_le_bytes());
            bytes.extend(cell.bounds().iter().flatten().flat_map(|at| at.to_le_bytes()));
            bytes.extend(points.to_le_bytes());
            for tally in tallies {
                bytes.extend(tally.asked.to_le_bytes());
                bytes.extend(tally.free.to_le_bytes());
            }
        }
        let hash = Hash::of(&bytes);
        bytes.extend(hash.to_le_bytes());
        bytes
    }

    /// The map of a file's bytes; or what is wrong with them, and the mend.
    pub fn from_bytes(bytes: &[u8]) -> std::result::Result<Self, String> {
        const AGAIN: &str = "make it again with `occlude map`";
        if !bytes.starts_with(MAGIC) {
            return Err("is not a map: `occlude map SCENE -o FILE` makes one".to_owned());
        }
        let damaged = |what: &str| format!("{what}: {AGAIN}");
        if bytes.len() < HEAD + 8 {
            return Err(damaged("ends early"));
        }
        let (body, hash) = bytes.split_at(bytes.len() - 8);
        let mut rest = Bytes(&body[MAGIC.len()..]);
        match rest.u32() {
            ORDER => {}
            order if order == ORDER.swap_bytes() => {
                return Err(damaged("was written with the bytes of numbers in the other order"));
            }
            _ => return Err(damaged("is damaged")),
        }
        let version = rest.u32();
        if version != VERSION {
            return Err(damaged(&format!(
                "is of version {version}, and this program reads version {VERSION}"
            )));
        }
        let (belongs_to, count) = (rest.u64(), rest.u64());
        let expected = (count as u128) * EACH as u128 + (HEAD + 8) as u128;
        if (bytes.len() as u128) < expected {
            return Err(damaged("ends early"));
        }
        if bytes.len() as u128 != expected || Hash::of(body).to_le_bytes() != hash {
            return Err(damaged("is damaged"));
        }
        let (passes, shadow_rays) = (rest.u32(), rest.u32());
        let doubts = Doubts {
            asked: std::array::from_fn(|_| rest.u64()),
            squared: std::array::from_fn(|_| rest.u64()),
        };
        let kinds = Seen(std::array::from_fn(|_| [rest.u64(), rest.u64()]));
        // Sums of these must not overflow.
        let counts = doubts.asked.iter().chain(&doubts.squared).chain(kinds.0.iter().flatten());
        if counts.copied().any(|count| count > u64::MAX / 4) {
            return Err(damaged("is damaged"));
        }
        let mut cells = Vec::with_capacity(count as usize);
        for _ in 0..count {
            let key = CellKey::from_bits(rest.u64());
            let bounds = [rest.three(), rest.three(), rest.three()];
            let points = rest.u32();
            let tallies = std::array::from_fn(|_| Tally { asked: rest.u32(), free: rest.u32() });
            let cell = MapCell::restore(key, bounds).ok_or_else(|| damaged("is damaged"))?;
            if tallies.iter().any(|tally: &Tally| tally.free > tally.asked) {
                return Err(damaged("is damaged"));
            }
            cells.push(SavedCell { cell, points, tallies });
        }
        Ok(Self { belongs_to, passes, shadow_rays, doubts, kinds, cells })
    }

    /// Reads a file.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(Error::io("reading", path))?;
        Self::from_bytes(&bytes).map_err(|message| Error::input(path, message))
    }

    /// Writes a file: all of it or none.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        output::write_bytes(path, &self.to_bytes())
    }

    /// Refuses a map of other triangles or lights.
    pub fn check(&self, path: impl AsRef<Path>, stage: &Stage<'_>) -> Result<()> {
        if self.belongs_to == fingerprint(stage) {
            return Ok(());
        }
        Err(Error::input(
            path,
            format!(
                "belongs to other triangles or lights than {}: make one of this scene with `occlude map SCENE -o FILE`",
                stage.scene.name
            ),
        ))
    }

    /// What it holds, as text.
    pub fn describe(&self) -> String {
        let (mut rays, mut free, mut full) = (0u64, 0u64, 0usize);
        let mut kinds = [0usize; 4];
        let mut lights: Vec<u32> = Vec::new();
        let mut sizes = [usize::MAX, 0];
        for SavedCell { cell, tallies, .. } in &self.cells {
            let asked: u64 = tallies.iter().map(|tally| u64::from(tally.asked)).sum();
            let reached: u64 = tallies.iter().map(|tally| u64::from(tally.free)).sum();
            rays += asked;
            free += reached;
            full += tallies.iter().filter(|tally| tally.asked > 0).count();
            kinds[match (asked, reached) {
                (0, _) => 0,
                (asked, reached) if asked == reached => 1,
                (_, 0) => 2,
                _ => 3,
            }] += 1;
            lights.push(cell.key().light());
            sizes = [sizes[0].min(asked as usize), sizes[1].max(asked as usize)];
        }
        lights.sort_unstable();
        lights.dedup();
        let cells = self.cells.len();
        let percent = |part: usize, whole: usize| 100.0 * part as f64 / whole.max(1) as f64;
        let mut text = format!(
            "cells          {cells}, of {} lights\nlearned from   {} passes of {} shadow rays: {rays} rays, {:.1} % of them free\n",
            lights.len(),
            self.passes,
            self.shadow_rays,
            100.0 * free as f64 / rays.max(1) as f64,
        );
        text += &format!(
            "seen           nothing {:.1} %, only light {:.1} %, only dark {:.1} %, both {:.1} % of the cells\n",
            percent(kinds[0], cells),
            percent(kinds[1], cells),
            percent(kinds[2], cells),
            percent(kinds[3], cells),
        );
        text += &format!(
            "bins           {:.1} % were asked; {} to {} rays a cell\n",
            percent(full, cells * BINS),
            if cells == 0 { 0 } else { sizes[0] },
            sizes[1]
        );
        text += "doubt          variance of V - u by class, from most doubt to least:\n              ";
        for class in 0..CLASSES {
            text += &format!(" {:.4}", self.doubts.variance(class));
        }
        text += &format!("\nbelongs to     {:016x}\n", self.belongs_to);
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn saved() -> SavedMap {
        let cells = (0..5u32)
            .map(|k| {
                let x = [k as f32, 0.5, -1.0];
                let key = CellKey::new(x, [0.0, 0.0, 1.0], 0, k % 2).expect("near");
                let mut cell = MapCell::new(key, [0.0, 0.0, 1.0]);
                cell.add(x);
                let tallies =
                    std::array::from_fn(|bin| Tally { asked: bin as u32 + k, free: bin as u32 / 2 });
                SavedCell { cell, points: k, tallies }
            })
            .collect();
        let mut doubts = Doubts::default();
        doubts.asked[3] = 1 << 20;
        doubts.squared[3] = 1 << 30;
        let mut kinds = Seen::default();
        kinds.0[KINDS - 1] = [1 << 40, 3];
        SavedMap { belongs_to: 42, passes: 7, shadow_rays: 64, doubts, kinds, cells }
    }

    #[test]
    fn what_is_written_is_read() {
        let first = saved();
        let bytes = first.to_bytes();
        let again = SavedMap::from_bytes(&bytes).expect("whole");
        assert_eq!(again.to_bytes(), bytes);
        assert_eq!((again.belongs_to, again.passes, again.shadow_rays), (42, 7, 64));
        assert_eq!((again.doubts, again.kinds), (first.doubts, first.kinds));
        assert!(again.describe().contains("7 passes of 64"));
    }

    #[test]
    fn what_is_not_whole_is_refused_with_the_reason() {
        let bytes = saved().to_bytes();
        let refused = |bytes: &[u8], why: &str| {
            let message = SavedMap::from_bytes(bytes).expect_err(why);
            assert!(message.contains(why), "{message:?} for {why:?}");
        };
        refused(b"", "is not a map");
        refused(b"# an obj\n", "is not a map");
        for length in [8, 20, HEAD, HEAD + EACH, bytes.len() - 1] {
            refused(&bytes[..length], "ends early");
        }
        refused(&[&bytes[..], &[0]].concat(), "is damaged");
        for at in [17, 41, HEAD + 3, HEAD + 2 * EACH + 60, bytes.len() - 1] {
            let mut damaged = bytes.clone();
            damaged[at] ^= 16;
            refused(&damaged, "is damaged");
        }
        let mut other = bytes.clone();
        other[12..16].copy_from_slice(&9u32.to_le_bytes());
        refused(&other, "is of version 9");
        let mut turned = bytes.clone();
        turned[8..12].reverse();
        refused(&turned, "the other order");
        // Cells without end do not take memory before they are found not to be there.
        let mut endless = bytes;
        endless[24..32].copy_from_slice(&u64::MAX.to_le_bytes());
        refused(&endless, "ends early");
    }

    #[test]
    fn what_no_map_can_hold_is_refused_even_with_the_right_hash() {
        let mut impossible = saved();
        impossible.cells[1].tallies[3] = Tally { asked: 1, free: 2 };
        assert!(SavedMap::from_bytes(&impossible.to_bytes()).is_err());
        let mut endless = saved();
        endless.kinds.0[5][1] = u64::MAX;
        assert!(SavedMap::from_bytes(&endless.to_bytes()).is_err(), "the next would overflow");
        let mut nowhere = saved();
        nowhere.cells[2].cell = MapCell::new(nowhere.cells[2].cell.key(), [0.0, 0.0, 1.0]);
        assert!(SavedMap::from_bytes(&nowhere.to_bytes()).is_err(), "bounds without end");
    }
}
