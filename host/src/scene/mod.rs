//! Scenes as their files describe them: triangles, materials, a camera.

mod camera;

pub use camera::{Camera, CameraFrame, CameraRequest};

use glam::Vec3;
use std::ops::Range;

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
    /// Vertices, finite, below 1e18 in magnitude.
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
}

/// TEMP
pub fn load(path: &std::path::Path, _r: &CameraRequest) -> crate::Result<Scene> {
    let file = if path.is_dir() { path.join("scene.obj") } else { path.to_owned() };
    let (models, mats) =
        tobj::load_obj(&file, &tobj::LoadOptions { triangulate: true, ..Default::default() })
            .map_err(|e| crate::Error::input(&file, e.to_string()))?;
    let mats = mats.map_err(|e| crate::Error::input(&file, e.to_string()))?;
    let mut s =
        Scene { name: path.file_stem().unwrap().to_string_lossy().into_owned(), ..Default::default() };
    for m in mats {
        let p = |v: Option<[f32; 3]>| v.map(Vec3::from).unwrap_or_default();
        s.materials.push(Material { name: m.name.clone(), diffuse: p(m.diffuse), emission: p(m.emissive) });
    }
    for m in models {
        let base = s.positions.len() as u32;
        s.positions.extend(m.mesh.positions.chunks(3).map(|c| Vec3::new(c[0], c[1], c[2])));
        for t in m.mesh.indices.chunks(3) {
            s.triangles.push([t[0] + base, t[1] + base, t[2] + base]);
            s.triangle_materials.push(m.mesh.material_id.unwrap() as u32);
        }
    }
    let cam = std::fs::read(file.with_file_name("camera.json")).unwrap();
    s.camera = Some(serde_json::from_slice(&cam).unwrap());
    Ok(s)
}
