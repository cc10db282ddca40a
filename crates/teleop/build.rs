//! Lets binaries find the MuJoCo library that `mujoco-native` provided, also when started directly.
fn main() {
    if let Ok(dir) = std::env::var("DEP_MUJOCO_NATIVE_LIBDIR") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{dir}");
        println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN"); // a copied binary finds a copied library beside it
    }
}
