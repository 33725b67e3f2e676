//! A grid over the map: test rays for each cell, and not for each point.

use super::Map;
use glam::Vec3;
use occlude_kernel::OneTerm;
use occlude_kernel::photons::PhotonId;
use std::collections::HashMap;
use std::sync::OnceLock;

/// Photons of a cell that test rays start at, at most: spread over it as the photons are.
const STARTS: usize = 8;

/// The cells of one light that hold photons.
///
/// What a cell's test rays say follows from its photons alone, so it does not matter which of its points asks first, nor
/// in which thread.
#[derive(Debug)]
pub(super) struct Cells {
    edge: f32,
    places: HashMap<[i32; 3], u32>,
    starts: Vec<Vec<PhotonId>>,
    terms: Vec<OnceLock<Option<OneTerm>>>,
}

impl Cells {
    /// For each light of a map. Cells are as wide as the disc that holds the k nearest photons on average.
    pub(super) fn of(map: &Map<'_>) -> Vec<Self> {
        let of_light = |light: usize| {
            let edge = map.prepared.radii[light] * (2.0 / 3.0);
            let blocks = map.photons[light].map().blocks();
            let ids = blocks.iter().flat_map(|block| block.ids).filter(|&id| id != PhotonId::NONE);
            let mut all: Vec<([i32; 3], PhotonId)> =
                ids.map(|id| (key(Vec3::from(map.prepared.store.position(id)), edge), id)).collect();
            all.sort_unstable();
            let (mut places, mut starts) = (HashMap::new(), Vec::new());
            for cell in all.chunk_by(|a, b| a.0 == b.0) {
                places.insert(cell[0].0, starts.len() as u32);
                let many = cell.len().min(STARTS);
                starts.push((0..many).map(|i| cell[i * cell.len() / many].1).collect());
            }
            let terms = starts.iter().map(|_| OnceLock::new()).collect();
            Self { edge, places, starts, terms }
        };
        (0..map.photons.len()).map(of_light).collect()
    }

    /// The cell of a point, if it holds photons.
    pub(super) fn find(&self, x: Vec3) -> Option<u32> {
        self.places.get(&key(x, self.edge)).copied()
    }

    /// The photons that a cell's test rays start at.
    pub(super) fn starts(&self, cell: u32) -> &[PhotonId] {
        &self.starts[cell as usize]
    }

    /// What its test rays said, if they were asked: the terms they speak for, or nothing.
    pub(super) fn known(&self, cell: u32) -> Option<Option<OneTerm>> {
        self.terms[cell as usize].get().copied()
    }

    /// Keeps what they said; false if somebody else was first, who was told the same.
    pub(super) fn learn(&self, cell: u32, one: Option<OneTerm>) -> bool {
        self.terms[cell as usize].set(one).is_ok()
    }
}

fn key(x: Vec3, edge: f32) -> [i32; 3] {
    // Beyond what an i32 holds, cells are one.
    (x / edge).floor().to_array().map(|at| at as i32)
}
