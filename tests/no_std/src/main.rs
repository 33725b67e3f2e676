//! Traces rays with no std, no allocator and no C library, and exits with 0 if the answers are right.

#![no_std]
#![no_main]

use core::arch::{asm, global_asm};
use core::ops::ControlFlow;
use occlude_kernel::lanes::Simd;
use occlude_kernel::{BatchScratch, Bvh, Child, Counts, Node, Ray, RayPacket, Scalar, Targets, TriangleBlock};

global_asm!(".globl _start", "_start:", "xor ebp, ebp", "and rsp, -16", "call {main}", main = sym main);

extern "C" fn main() -> ! {
    exit(trace())
}

/// The number of the first question whose answer is wrong; 0 if none is.
fn trace() -> i32 {
    let mut block = TriangleBlock::EMPTY;
    block.set(0, [[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [0.0, 1.0, 1.0]], 7);
    block.set(1, [[-1.0, -1.0, 3.0], [1.0, -1.0, 3.0], [0.0, 1.0, 3.0]], 4);
    let mut root = Node::EMPTY;
    root.set(0, [-1.0, -1.0, 1.0], [1.0, 1.0, 3.0], Child::leaf(0));
    let (nodes, blocks) = ([root], [block]);
    let Ok(bvh) = Bvh::new(&nodes, &blocks) else { return 1 };
    let wrong = ask(&bvh).max(ask(&bvh.on(Scalar)));
    #[cfg(feature = "dispatch")]
    let wrong = {
        struct Ask<'a>(Bvh<'a>);
        impl occlude_kernel::lanes::Task for Ask<'_> {
            type Output = i32;
            #[inline(always)]
            fn run<S: Simd>(self, simd: S) -> i32 {
                ask(&self.0.on(simd))
            }
        }
        wrong.max(occlude_kernel::lanes::dispatch(occlude_kernel::lanes::detect(), Ask(bvh)))
    };
    wrong
}

#[inline(always)]
fn ask<S: Simd>(bvh: &Bvh<'_, S>) -> i32 {
    let mut counts = Counts::default();
    let through = Ray::segment([0.0; 3], [0.0, 0.0, 2.0]);
    if bvh.occluder(&through, None, &mut counts) != Some(7) {
        return 2;
    }
    if bvh.occluded(&through, Some(7), &mut counts) {
        return 3;
    }
    let on = Ray::from([0.1, 0.0, 4.0], [0.0, 0.0, -2.0]);
    match bvh.closest(&on, None, &mut counts) {
        Some(hit) if hit.triangle == 4 && hit.t == 0.5 => (),
        _ => return 4,
    }
    let (mut sum, mut told) = (0.0, 0);
    bvh.each_hit_in_order(&on, None, &mut counts, |hit| {
        sum += hit.t;
        told += 1;
        ControlFlow::Continue(())
    });
    if (sum, told) != (2.0, 2) {
        return 5;
    }
    let packet = RayPacket::new(&[on, through, Ray::from([5.0; 3], [1.0, 0.0, 0.0])]);
    if bvh.occluded_packet(&packet, 0b111, None, &mut counts) != 0b011 {
        return 6;
    }
    // Points behind both triangles, and every fifth beside them.
    let (mut x, y, z) = ([0.0; 100], [0.0; 100], [5.0; 100]);
    for (i, x) in x.iter_mut().enumerate() {
        *x = if i % 5 == 0 { 90.0 } else { i as f32 * 0.001 };
    }
    let Some(targets) = Targets::new(&x, &y, &z) else { return 7 };
    let mut blocked = [0; 2];
    bvh.occluded_batch([0.0; 3], &targets, None, &mut counts, &mut BatchScratch::new(), &mut blocked);
    for i in 0..100 {
        if (blocked[i / 64] >> (i % 64) & 1 != 0) != (i % 5 != 0) {
            return 8;
        }
    }
    if counts.rays != 1 + 1 + 1 + 1 + 3 + 100 { 9 } else { 0 }
}

fn exit(code: i32) -> ! {
    // SAFETY: the system call 60 ends the process and touches no memory.
    unsafe { asm!("syscall", in("rax") 60, in("rdi") code, options(noreturn)) }
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    exit(101)
}

/// The precompiled core names it; nothing unwinds here.
#[unsafe(no_mangle)]
extern "C" fn rust_eh_personality() {}

/// What the compiler calls for copies, moves, fills and comparisons.
mod memory {
    use core::arch::asm;

    #[unsafe(no_mangle)]
    unsafe extern "C" fn memcpy(to: *mut u8, from: *const u8, count: usize) -> *mut u8 {
        // SAFETY: the caller promises `count` bytes at both, apart from each other.
        unsafe {
            asm!("rep movsb", inout("rcx") count => _, inout("rdi") to => _, inout("rsi") from => _,
                options(nostack, preserves_flags));
        }
        to
    }

    #[unsafe(no_mangle)]
    unsafe extern "C" fn memmove(to: *mut u8, from: *const u8, count: usize) -> *mut u8 {
        if (to as usize).wrapping_sub(from as usize) >= count {
            // SAFETY: going up, nothing is overwritten before it is read.
            return unsafe { memcpy(to, from, count) };
        }
        // SAFETY: the caller promises `count` bytes at both; going down from the last of them.
        unsafe {
            asm!("std", "rep movsb", "cld", inout("rcx") count => _,
                inout("rdi") to.wrapping_add(count).wrapping_sub(1) => _,
                inout("rsi") from.wrapping_add(count).wrapping_sub(1) => _, options(nostack));
        }
        to
    }

    #[unsafe(no_mangle)]
    unsafe extern "C" fn memset(to: *mut u8, value: i32, count: usize) -> *mut u8 {
        // SAFETY: the caller promises `count` bytes.
        unsafe {
            asm!("rep stosb", inout("rcx") count => _, inout("rdi") to => _, in("al") value as u8,
                options(nostack, preserves_flags));
        }
        to
    }

    #[unsafe(no_mangle)]
    unsafe extern "C" fn memcmp(left: *const u8, right: *const u8, count: usize) -> i32 {
        for i in 0..count {
            // SAFETY: the caller promises `count` bytes at both. Volatile, lest the loop become a call of itself.
            let (left, right) = unsafe { (left.add(i).read_volatile(), right.add(i).read_volatile()) };
            if left != right {
                return i32::from(left) - i32::from(right);
            }
        }
        0
    }
}
