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

/// A camera, ready to give rays.
#[derive(Clone, Copy, Debug)]
pub struct CameraFrame {
    /// The pinhole.
    pub eye: Vec3,
    forward: glam::DVec3,
    right: glam::DVec3,
    down: glam::DVec3,
}
impl Camera {
    /// f
    pub fn frame(&self) -> CameraFrame {
        let f = (self.target.as_dvec3() - self.eye.as_dvec3()).normalize();
        let r = f.cross(self.up.as_dvec3()).normalize();
        let u = r.cross(f);
        let h = (f64::from(self.vfov_deg).to_radians() * 0.5).tan();
        let (w, hh) = (f64::from(self.width), f64::from(self.height));
        CameraFrame {
            eye: self.eye,
            forward: f - r * (h * w / hh) + u * h,
            right: r * (2.0 * h / hh),
            down: -u * (2.0 * h / hh),
        }
    }
}
impl CameraFrame {
    /// d
    pub fn direction(&self, px: f32, py: f32) -> Vec3 {
        (self.forward + self.right * f64::from(px) + self.down * f64::from(py)).normalize().as_vec3()
    }
}
/// r
#[derive(Clone, Debug, Default)]
pub struct CameraRequest {
    /// f
    pub file: Option<std::path::PathBuf>,
    /// f
    pub eye: Option<Vec3>,
    /// f
    pub target: Option<Vec3>,
    /// f
    pub up: Option<Vec3>,
    /// f
    pub vfov_deg: Option<f32>,
    /// f
    pub size: Option<(u32, u32)>,
}
