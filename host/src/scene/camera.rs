//! A pinhole camera.

use glam::Vec3;

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
