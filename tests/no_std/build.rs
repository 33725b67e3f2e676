fn main() {
    // No C start-up code, no C library, no loader.
    for argument in ["-nostartfiles", "-nodefaultlibs", "-static"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
}
