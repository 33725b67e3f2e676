//! Intel Embree 3 (Debian's `libembree-dev`), by the few functions of its C interface that any-hit queries need.
//!
//! The signatures, constants and layouts below are those of `rtcore_*.h`, version 3.13.

#![expect(unsafe_code, reason = "a C interface")]

use crate::pack::{Packed, Tracer};
use crate::{Peer, Work, builds};
use glam::Vec3;
use occlude_host::scene::Scene;
use occlude_kernel::lanes::{Level, dispatch};
use std::ffi::{c_char, c_int, c_uint, c_void};
use std::sync::atomic::{AtomicIsize, Ordering};
use std::time::{Duration, Instant};

type Handle = *mut c_void;

/// `RTCIntersectContext`.
#[repr(C)]
struct Context {
    flags: c_uint,
    filter: *const c_void,
    instance: c_uint,
    /// There only if the library was built with `EMBREE_MIN_WIDTH`; harmless otherwise.
    min_width: f32,
}

impl Context {
    fn new(coherent: bool) -> Self {
        Self {
            flags: c_uint::from(coherent),
            filter: std::ptr::null(),
            instance: c_uint::MAX,
            min_width: 0.0,
        }
    }
}

/// `RTCRay`, `RTCRay8` and `RTCRay16`, which differ in the length of the arrays only.
#[derive(Clone)]
#[repr(C, align(64))]
struct Rays<const W: usize> {
    origin: [[f32; W]; 3],
    near: [f32; W],
    direction: [[f32; W]; 3],
    time: [f32; W],
    far: [f32; W],
    mask: [c_uint; W],
    id: [c_uint; W],
    flags: [c_uint; W],
}

#[link(name = "embree3")]
unsafe extern "C" {
    fn rtcNewDevice(config: *const c_char) -> Handle;
    fn rtcReleaseDevice(device: Handle);
    fn rtcGetDeviceError(device: Handle) -> c_uint;
    fn rtcGetDeviceProperty(device: Handle, property: c_uint) -> isize;
    fn rtcSetDeviceMemoryMonitorFunction(
        device: Handle,
        monitor: extern "C" fn(*mut c_void, isize, bool) -> bool,
        user: *const c_void,
    );
    fn rtcNewScene(device: Handle) -> Handle;
    fn rtcReleaseScene(scene: Handle);
    fn rtcSetSceneFlags(scene: Handle, flags: c_uint);
    fn rtcSetSceneBuildQuality(scene: Handle, quality: c_uint);
    fn rtcCommitScene(scene: Handle);
    fn rtcNewGeometry(device: Handle, kind: c_uint) -> Handle;
    fn rtcSetNewGeometryBuffer(
        geometry: Handle,
        kind: c_uint,
        slot: c_uint,
        format: c_uint,
        stride: usize,
        count: usize,
    ) -> *mut c_void;
    fn rtcSetGeometryBuildQuality(geometry: Handle, quality: c_uint);
    fn rtcCommitGeometry(geometry: Handle);
    fn rtcAttachGeometry(scene: Handle, geometry: Handle) -> c_uint;
    fn rtcReleaseGeometry(geometry: Handle);
    fn rtcOccluded1(scene: Handle, context: *mut Context, ray: *mut Rays<1>);
    fn rtcOccluded8(valid: *const c_int, scene: Handle, context: *mut Context, rays: *mut Rays<8>);
    fn rtcOccluded16(valid: *const c_int, scene: Handle, context: *mut Context, rays: *mut Rays<16>);
}

const ROBUST: c_uint = 1 << 2;
const HIGH: c_uint = 2;
const TRIANGLES: c_uint = 0;
const INDICES: c_uint = 0;
const VERTICES: c_uint = 1;
const UINT3: c_uint = 0x5003;
const FLOAT3: c_uint = 0x9003;
const VERSION: c_uint = 0;

/// A scene built for the highest quality, fast or robust.
pub struct Embree {
    device: Handle,
    scene: Handle,
    bytes: Box<AtomicIsize>,
    /// What the tree takes, without the vertices and indices it was made of.
    tree: usize,
    /// How long it took to build, on all threads.
    pub built: Duration,
}

extern "C" fn monitor(user: *mut c_void, bytes: isize, _: bool) -> bool {
    // SAFETY: `user` is the counter that the device's owner keeps for as long as the device.
    let total = unsafe { &*user.cast::<AtomicIsize>() };
    total.fetch_add(bytes, Ordering::Relaxed);
    true
}

impl Embree {
    /// Builds it. `None`, with a message, if the library fails.
    pub fn new(scene: &Scene, robust: bool) -> Option<Self> {
        let bytes = Box::new(AtomicIsize::new(0));
        // SAFETY: handles go only where they came from; buffers are written within the sizes asked for; the
        // counter outlives the device, which `drop` releases.
        unsafe {
            let device = rtcNewDevice(std::ptr::null());
            if device.is_null() {
                eprintln!("Embree cannot start: error {}", rtcGetDeviceError(std::ptr::null_mut()));
                return None;
            }
            rtcSetDeviceMemoryMonitorFunction(device, monitor, std::ptr::from_ref(&*bytes).cast());
            let built = rtcNewScene(device);
            rtcSetSceneFlags(built, if robust { ROBUST } else { 0 });
            rtcSetSceneBuildQuality(built, HIGH);
            let geometry = rtcNewGeometry(device, TRIANGLES);
            rtcSetGeometryBuildQuality(geometry, HIGH);
            let (points, faces) = (scene.positions.len(), scene.triangles.len());
            let vertices =
                rtcSetNewGeometryBuffer(geometry, VERTICES, 0, FLOAT3, 12, points).cast::<[f32; 3]>();
            let indices = rtcSetNewGeometryBuffer(geometry, INDICES, 0, UINT3, 12, faces).cast::<[u32; 3]>();
            if !vertices.is_null() && !indices.is_null() {
                for (i, position) in scene.positions.iter().enumerate() {
                    vertices.add(i).write(position.to_array());
                }
                for (i, corners) in scene.triangles.iter().enumerate() {
                    indices.add(i).write(*corners);
                }
            }
            rtcCommitGeometry(geometry);
            rtcAttachGeometry(built, geometry);
            rtcReleaseGeometry(geometry);
            let before = bytes.load(Ordering::Relaxed);
            let start = Instant::now();
            rtcCommitScene(built);
            let took = start.elapsed();
            let error = rtcGetDeviceError(device);
            let tree = (bytes.load(Ordering::Relaxed) - before).max(0) as usize;
            let this = Self { device, scene: built, bytes, tree, built: took };
            if error != 0 {
                eprintln!("Embree cannot build the scene: error {error}");
                return None;
            }
            Some(this)
        }
    }

    /// The last of some builds of it, with the least time of them.
    pub fn quickest(scene: &Scene, robust: bool) -> Option<Self> {
        let mut tree = Self::new(scene, robust)?;
        for _ in 1..builds(scene) {
            let before = tree.built;
            drop(tree);
            tree = Self::new(scene, robust)?;
            tree.built = tree.built.min(before);
        }
        Some(tree)
    }

    /// Its version, as 31305 for 3.13.5.
    pub fn version(&self) -> isize {
        // SAFETY: the device is alive.
        unsafe { rtcGetDeviceProperty(self.device, VERSION) }
    }

    /// Bytes of the tree, without the vertices and indices it was made of.
    pub fn tree_bytes(&self) -> usize {
        self.tree
    }

    /// Bytes that the device holds, with vertices and indices.
    pub fn all_bytes(&self) -> usize {
        self.bytes.load(Ordering::Relaxed).max(0) as usize
    }

    /// Answers all of the work: a word a batch.
    pub fn answer(&self, mode: Mode, level: Level, work: &Work, blocked: &mut [u64]) {
        let context = Context::new(mode.coherent);
        match mode.width {
            16 => dispatch(level, Packed { tracer: Wide::<16> { tree: self, context }, work, blocked }),
            8 => dispatch(level, Packed { tracer: Wide::<8> { tree: self, context }, work, blocked }),
            _ => dispatch(level, Packed { tracer: One { tree: self, context }, work, blocked }),
        }
    }
}

impl Drop for Embree {
    fn drop(&mut self) {
        // SAFETY: nobody else holds these handles.
        unsafe {
            rtcReleaseScene(self.scene);
            rtcReleaseDevice(self.device);
        }
    }
}

/// A way to ask it.
#[derive(Clone, Copy, Debug)]
pub struct Mode {
    /// What it is called.
    pub name: &'static str,
    /// Rays a call: 1, 8 or 16.
    pub width: usize,
    /// Whether rays are said to be coherent.
    pub coherent: bool,
    /// Whether the tree is the robust one.
    pub robust: bool,
}

/// All of them.
pub const MODES: [Mode; 12] = [
    Mode { name: "embree 1", width: 1, coherent: false, robust: false },
    Mode { name: "embree 1 coherent", width: 1, coherent: true, robust: false },
    Mode { name: "embree 8", width: 8, coherent: false, robust: false },
    Mode { name: "embree 8 coherent", width: 8, coherent: true, robust: false },
    Mode { name: "embree 16", width: 16, coherent: false, robust: false },
    Mode { name: "embree 16 coherent", width: 16, coherent: true, robust: false },
    Mode { name: "embree robust 1", width: 1, coherent: false, robust: true },
    Mode { name: "embree robust 1 coherent", width: 1, coherent: true, robust: true },
    Mode { name: "embree robust 8", width: 8, coherent: false, robust: true },
    Mode { name: "embree robust 8 coherent", width: 8, coherent: true, robust: true },
    Mode { name: "embree robust 16", width: 16, coherent: false, robust: true },
    Mode { name: "embree robust 16 coherent", width: 16, coherent: true, robust: true },
];

/// All modes of a fast and a robust tree, as far as there is one.
pub fn peers(trees: &[Option<Embree>; 2], level: Level) -> impl Iterator<Item = Peer<'_>> {
    MODES.into_iter().filter_map(move |mode| {
        let tree = trees[usize::from(mode.robust)].as_ref()?;
        let answer =
            Box::new(move |work: &Work, blocked: &mut [u64]| tree.answer(mode, level, work, blocked));
        Some(Peer { name: mode.name.to_owned(), family: "embree", answer })
    })
}

struct One<'a> {
    tree: &'a Embree,
    context: Context,
}

struct Wide<'a, const W: usize> {
    tree: &'a Embree,
    context: Context,
}

impl<const W: usize> Rays<W> {
    fn empty() -> Self {
        Self {
            origin: [[0.0; W]; 3],
            near: [0.0; W],
            direction: [[0.0; W]; 3],
            time: [0.0; W],
            far: [1.0; W],
            mask: [c_uint::MAX; W],
            id: [0; W],
            flags: [0; W],
        }
    }

    #[allow(clippy::needless_range_loop, reason = "several arrays side by side")]
    #[inline(always)]
    fn fill(&mut self, origin: Vec3, targets: [&[f32; W]; 3]) {
        let origin = origin.to_array();
        for axis in 0..3 {
            for lane in 0..W {
                self.origin[axis][lane] = origin[axis];
                self.direction[axis][lane] = targets[axis][lane] - origin[axis];
            }
        }
        self.far = [1.0; W];
    }

    #[inline(always)]
    fn put(&mut self, lane: usize, origin: Vec3, target: [f32; 3]) {
        let origin = origin.to_array();
        for axis in 0..3 {
            self.origin[axis][lane] = origin[axis];
            self.direction[axis][lane] = target[axis] - origin[axis];
        }
        self.far[lane] = 1.0;
    }

    /// Blocked rays are those whose far end was moved to minus infinity.
    #[inline(always)]
    fn blocked(&self) -> u32 {
        let mut bits = 0;
        for lane in 0..W {
            bits |= u32::from(self.far[lane] < 0.0) << lane;
        }
        bits
    }
}

impl Tracer<1> for One<'_> {
    type Packet = Rays<1>;

    fn packet(&self) -> Rays<1> {
        Rays::empty()
    }

    #[inline(always)]
    fn fill(packet: &mut Rays<1>, origin: Vec3, targets: [&[f32; 1]; 3]) {
        packet.fill(origin, targets);
    }

    #[inline(always)]
    fn put(packet: &mut Rays<1>, lane: usize, origin: Vec3, target: [f32; 3]) {
        packet.put(lane, origin, target);
    }

    #[inline(always)]
    fn trace(&mut self, packet: &mut Rays<1>, _: u32) -> u32 {
        // SAFETY: the scene is built, and the ray has the layout and alignment asked for.
        unsafe { rtcOccluded1(self.tree.scene, &raw mut self.context, packet) };
        packet.blocked()
    }
}

/// The valid flags of a packet's lanes.
#[inline(always)]
fn valid<const W: usize>(active: u32) -> Valid<W> {
    let mut valid = Valid([0; W]);
    for lane in 0..W {
        valid.0[lane] = -((active >> lane & 1) as c_int);
    }
    valid
}

#[repr(C, align(64))]
struct Valid<const W: usize>([c_int; W]);

macro_rules! wide {
    ($width:literal, $function:ident) => {
        impl Tracer<$width> for Wide<'_, $width> {
            type Packet = Rays<$width>;

            fn packet(&self) -> Rays<$width> {
                Rays::empty()
            }

            #[inline(always)]
            fn fill(packet: &mut Rays<$width>, origin: Vec3, targets: [&[f32; $width]; 3]) {
                packet.fill(origin, targets);
            }

            #[inline(always)]
            fn put(packet: &mut Rays<$width>, lane: usize, origin: Vec3, target: [f32; 3]) {
                packet.put(lane, origin, target);
            }

            #[inline(always)]
            fn trace(&mut self, packet: &mut Rays<$width>, active: u32) -> u32 {
                let valid = valid::<$width>(active);
                // SAFETY: the scene is built, and flags and rays have the layouts and alignments asked for.
                unsafe { $function(valid.0.as_ptr(), self.tree.scene, &raw mut self.context, packet) };
                packet.blocked()
            }
        }
    };
}

wide!(8, rtcOccluded8);
wide!(16, rtcOccluded16);
