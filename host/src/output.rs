//! Images to files and back: png, exr, hdr and pfm, chosen by the extension.
//!
//! | extension | holds | loses |
//! |---|---|---|
//! | `.exr` | 32-bit floats, and the variance beside them | nothing |
//! | `.pfm` | 32-bit floats | nothing |
//! | `.hdr` | 8 bits a channel and a shared exponent (RGBE) | all but 1 % of the brightest channel; negative values |
//! | `.png` | 8 bits, sRGB curve, after an exposure | everything outside 0 to 1 |
//!
//! A file appears whole or not at all: it is written beside its destination under
//! another name, flushed to the disk, and renamed. A symbolic link is followed, an
//! existing file keeps its permissions, and a device or pipe is written to directly.
//! [`check_apart`] keeps a command from writing over what it reads, or writes.

use std::fs::{self, Metadata};
use std::io::{Cursor, ErrorKind, Write};
use std::path::{Path, PathBuf};

use exr::prelude as openexr;
use exr::prelude::{ReadChannels, ReadLayers, WritableImage};
use image::ImageEncoder;

use crate::error::{Error, Result};
use crate::film::Image;

/// More pixels than this in a file are taken for a damaged header.
const MAX_PIXELS: u64 = 1 << 28;

/// What a decoder returns: it knows what is wrong, and not in which file.
type Decoded<T> = std::result::Result<T, String>;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    Png,
    Exr,
    Hdr,
    Pfm,
}

impl Format {
    fn of(path: &Path) -> Result<Self> {
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        match extension.as_str() {
            "png" => Ok(Self::Png),
            "exr" => Ok(Self::Exr),
            "hdr" => Ok(Self::Hdr),
            "pfm" => Ok(Self::Pfm),
            _ => Err(Error::Usage(format!(
                "{}: an image's name ends in .png, .exr, .hdr or .pfm",
                path.display()
            ))),
        }
    }
}

/// Writes an image in the format its name ends in.
///
/// - `variance`, of every pixel, becomes the channels `variance.R`, `variance.G` and `variance.B` of an
///   `.exr`; the other formats have no place for it and leave it out.
/// - `exposure_ev` multiplies a `.png` by `2^exposure_ev` before it is clamped and encoded. The other
///   formats hold radiance, and radiance is not exposed.
/// - NaN is black in a `.png` and a `.hdr`, and NaN in an `.exr` and a `.pfm`.
pub fn write(
    path: impl AsRef<Path>,
    image: &Image,
    variance: Option<&Image>,
    exposure_ev: f32,
) -> Result<()> {
    let path = path.as_ref();
    let format = Format::of(path)?;
    let pixels = u64::from(image.width) * u64::from(image.height);
    if pixels == 0 {
        return Err(Error::Usage(format!("{}: an image without pixels cannot be written", path.display())));
    }
    if variance.is_some_and(|v| (v.width, v.height) != (image.width, image.height))
        || [Some(image), variance].into_iter().flatten().any(|i| i.pixels.len() as u64 != pixels)
    {
        return Err(Error::Usage(format!("{}: the number of pixels does not fit the size", path.display())));
    }
    let failed = |e: String| Error::input(path, format!("the image could not be encoded: {e}"));
    let bytes = match format {
        Format::Png => encode_png(image, exposure_ev).map_err(|e| failed(e.to_string()))?,
        Format::Exr => encode_exr(image, variance).map_err(|e| failed(e.to_string()))?,
        Format::Hdr => encode_hdr(image).map_err(|e| failed(e.to_string()))?,
        Format::Pfm => encode_pfm(image),
    };
    Destination::of(path)?.save(&bytes)
}

/// Whether the name ends like that of an image.
pub fn is_image(path: impl AsRef<Path>) -> bool {
    Format::of(path.as_ref()).is_ok()
}

/// Whether [`write()`] to this path is going to work, as far as can be told before there is an image.
///
/// The extension has to be known, the folder has to exist and let a file be made in it, and what stands
/// at the path, if anything, has to be a file that may be written.
pub fn check_writable(path: impl AsRef<Path>) -> Result<()> {
    Format::of(path.as_ref())?;
    Destination::of(path.as_ref())?.check()
}

/// An image as a PNG in memory, for pages that hold their pictures: as [`write()`] writes it, but with one channel
/// if it has no colours. `None` if it has no pixels.
pub fn png(image: &Image, exposure_ev: f32) -> Option<Vec<u8>> {
    let grey = image.pixels.iter().all(|[r, g, b]| r == g && g == b);
    if grey {
        let bytes = screen(image.pixels.iter().map(|[r, _, _]| r), exposure_ev);
        png_of(image, &bytes, image::ExtendedColorType::L8).ok()
    } else {
        encode_png(image, exposure_ev).ok()
    }
}

/// Writes a file of any kind as [`write()`] writes images: whole or not at all.
pub fn write_bytes(path: impl AsRef<Path>, bytes: &[u8]) -> Result<()> {
    Destination::of(path.as_ref())?.save(bytes)
}

/// The same as [`check_writable`] for [`write_bytes`], whatever the name ends in.
pub fn check_writable_bytes(path: impl AsRef<Path>) -> Result<()> {
    Destination::of(path.as_ref())?.check()
}

/// Refuses an output that would overwrite an input, or another output.
///
/// Each has the word that says what it is, like the option that names it, for the message. By whatever way a file is named,
/// it is the same file. Devices, pipes and what is open already are no files: nothing takes their place, and they may be named
/// as often as one likes. But the file behind an open one must not be an input.
pub fn check_apart(outputs: &[(&str, &Path)], inputs: &[(&str, &Path)]) -> Result<()> {
    let inputs: Vec<_> = inputs.iter().map(|&(what, path)| (what, path, file_at(path))).collect();
    for (what, path) in outputs {
        let behind = Destination::of_any(path).ok().filter(|destination| destination.stream.is_some());
        let behind = behind.and_then(|destination| fs::canonicalize(destination.file).ok());
        let read = inputs.iter().find(|(.., read)| read.is_some() && *read == behind);
        if let Some((input, its, _)) = read {
            return Err(Error::Usage(format!(
                "{what} {} would write to {input} {}, which is read: name another file",
                path.display(),
                its.display()
            )));
        }
    }
    let outputs: Vec<_> = outputs.iter().map(|&(what, path)| (what, path, file_at(path))).collect();
    for (k, (what, path, file)) in outputs.iter().enumerate().filter(|(_, (.., file))| file.is_some()) {
        let named = format!("{what} {}", path.display());
        if let Some((input, its, _)) = inputs.iter().find(|(.., read)| read == file) {
            return Err(Error::Usage(format!(
                "{named} would overwrite {input} {}, which is read: name another file",
                its.display()
            )));
        }
        if let Some((other, its, _)) = outputs[..k].iter().find(|(.., written)| written == file) {
            return Err(Error::Usage(format!(
                "{named} would overwrite {other} {}: name two files",
                its.display()
            )));
        }
    }
    Ok(())
}

/// The one path of a file that is there or could be made; `None` for what is no file.
fn file_at(path: &Path) -> Option<PathBuf> {
    let destination = Destination::of_any(path).ok().filter(|destination| !destination.is_special())?;
    let file = destination.file;
    // A folder may have several names, and on some systems a file in any case of its letters.
    fs::canonicalize(&file)
        .ok()
        .or_else(|| Some(fs::canonicalize(folder(&file)).ok()?.join(file.file_name()?)))
}

/// Reads an image in the format its name ends in, as linear radiance.
///
/// - `.exr`: half or float; `R`, `G` and `B`, or `Y`, of the first layer that has them. The pixels are
///   those of the data window.
/// - `.png`: 8 or 16 bits, decoded from sRGB; transparency is ignored.
pub fn read(path: impl AsRef<Path>) -> Result<Image> {
    let path = path.as_ref();
    let format = Format::of(path)?;
    let bytes = fs::read(path).map_err(Error::io("reading the image", path))?;
    let decoded = match format {
        Format::Png => decode_image(&bytes, image::ImageFormat::Png),
        Format::Exr => decode_exr(&bytes),
        Format::Hdr => decode_image(&bytes, image::ImageFormat::Hdr),
        Format::Pfm => decode_pfm(&bytes),
    };
    decoded.map_err(|message| Error::input(path, message))
}

/// What a screen can show: 0 to 1, and 0 for NaN.
pub fn clamp_to_screen(linear: f32) -> f32 {
    if linear > 0.0 { linear.min(1.0) } else { 0.0 }
}

/// The sRGB transfer curve, linear to encoded. Clamped to 0 to 1; NaN is 0.
pub fn srgb_encode(linear: f32) -> f32 {
    let linear = clamp_to_screen(linear);
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// The inverse of [`srgb_encode`] on 0 to 1.
pub fn srgb_decode(encoded: f32) -> f32 {
    if encoded <= 0.040_45 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

/// Where a file is going to be, symbolic links followed.
struct Destination<'a> {
    asked: &'a Path,
    file: PathBuf,
    existing: Option<Metadata>,
    stream: Option<Stream>,
}

/// Something that is open already, under its name in the file system. What is behind it may be a file with other things in
/// it, such as a log, of which no other file may take the place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stream {
    Stdout,
    Stderr,
    /// Of another number, or of another program.
    Other,
}

impl Stream {
    fn named(path: &Path) -> Option<Self> {
        match path.to_str()? {
            "/dev/stdout" | "/dev/fd/1" | "/proc/self/fd/1" => Some(Self::Stdout),
            "/dev/stderr" | "/dev/fd/2" | "/proc/self/fd/2" => Some(Self::Stderr),
            path => {
                let of_a_program =
                    || path.strip_prefix("/proc/")?.split_once("/fd/").map(|(_, number)| number);
                let number = path.strip_prefix("/dev/fd/").or_else(of_a_program)?;
                number.parse::<u32>().is_ok().then_some(Self::Other)
            }
        }
    }

    /// Could it be written to?
    fn check(self, path: &Path) -> std::io::Result<()> {
        match self {
            Self::Stdout | Self::Stderr => Ok(()),
            Self::Other => fs::OpenOptions::new().append(true).open(path).map(drop),
        }
    }

    /// Adds to what is there.
    fn write(self, path: &Path, bytes: &[u8]) -> std::io::Result<()> {
        match self {
            Self::Stdout => {
                let mut stdout = std::io::stdout().lock();
                stdout.write_all(bytes)?;
                stdout.flush()
            }
            Self::Stderr => std::io::stderr().lock().write_all(bytes),
            Self::Other => fs::OpenOptions::new().append(true).open(path)?.write_all(bytes),
        }
    }
}

impl<'a> Destination<'a> {
    fn of(asked: &'a Path) -> Result<Self> {
        let destination = Self::of_any(asked)?;
        if destination.existing.as_ref().is_some_and(|m| m.permissions().readonly()) {
            let what = "it exists and is read-only; remove it or choose another name";
            return Err(Error::Usage(format!("writing {}: {what}", asked.display())));
        }
        Ok(destination)
    }

    /// The same for a file that may be read-only.
    fn of_any(asked: &'a Path) -> Result<Self> {
        let mut file = asked.to_owned();
        // The links to a pipe lead nowhere, as those of /dev/stdout may.
        let is_special = fs::metadata(asked).is_ok_and(|m| !m.is_file() && !m.is_dir());
        // By hand, because the link may point to a file that is yet to be made.
        let mut stream = Stream::named(&file);
        for _ in 0..40 {
            let Ok(target) = fs::read_link(&file) else { break };
            if stream.is_some() {
                break;
            }
            file = folder(&file).join(target);
            stream = Stream::named(&file);
        }
        if stream.is_some() {
            return Ok(Self { asked, file, existing: None, stream });
        }
        if is_special {
            file = asked.to_owned();
        }
        let refuse = |why: String| Err(Error::Usage(format!("writing {}: {why}", asked.display())));
        if !is_special && file.is_symlink() {
            return refuse("it is a symbolic link that leads back to itself".into());
        }
        let existing = fs::metadata(&file).ok();
        if existing.as_ref().is_some_and(Metadata::is_dir) {
            return refuse("it is a folder; name a file in it".into());
        }
        // Of such a path the last part would be taken for the name of a file.
        let name = asked.to_string_lossy();
        if name.strip_suffix('.').unwrap_or(&name).ends_with(std::path::is_separator) {
            return refuse("it ends like the name of a folder; name a file".into());
        }
        match fs::metadata(folder(&file)) {
            Ok(m) if m.is_dir() => Ok(Self { asked, file, existing, stream }),
            Ok(_) => refuse(format!("{} is not a folder", folder(&file).display())),
            Err(e) if e.kind() == ErrorKind::NotFound => {
                refuse(format!("the folder {} does not exist; make it first", folder(&file).display()))
            }
            Err(e) => Err(Error::io("writing", asked)(e)),
        }
    }

    /// A device, a pipe or what is open already, which a rename would replace by a file.
    fn is_special(&self) -> bool {
        self.stream.is_some() || self.existing.as_ref().is_some_and(|m| !m.is_file())
    }

    fn temporary(&self) -> Result<tempfile::NamedTempFile> {
        let mut builder = tempfile::Builder::new();
        builder.prefix(".occlude-").suffix(".part");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            builder.permissions(fs::Permissions::from_mode(0o666)); // less the umask, as any new file
        }
        // The error names a file that nobody asked for; its kind says enough.
        builder.tempfile_in(folder(&self.file)).map_err(|error| match error.kind() {
            ErrorKind::PermissionDenied => Error::Usage(format!(
                "writing {}: no file may be made in the folder {}; choose another one, or have it made writable",
                self.asked.display(),
                folder(&self.file).display()
            )),
            kind => Error::io("writing", self.asked)(kind.into()),
        })
    }

    fn check(&self) -> Result<()> {
        if let Some(stream) = self.stream {
            return stream.check(&self.file).map_err(Error::io("writing", self.asked));
        }
        if self.is_special() {
            return Ok(());
        }
        self.temporary().map(drop)
    }

    fn save(&self, bytes: &[u8]) -> Result<()> {
        let failed = || Error::io("writing", self.asked);
        if let Some(stream) = self.stream {
            return stream.write(&self.file, bytes).map_err(failed());
        }
        if self.is_special() {
            return fs::write(&self.file, bytes).map_err(failed());
        }
        let mut temporary = self.temporary()?;
        temporary.write_all(bytes).map_err(failed())?;
        if let Some(existing) = &self.existing {
            temporary.as_file().set_permissions(existing.permissions()).map_err(failed())?;
        }
        temporary.as_file().sync_all().map_err(failed())?;
        temporary.persist(&self.file).map_err(|e| failed()(e.error))?;
        Ok(())
    }
}

/// Folders that were made for something, and are gone again if nothing came into them.
#[derive(Debug)]
pub(crate) struct MadeFolders(Vec<PathBuf>);

impl MadeFolders {
    /// Makes a folder, and those that it is in.
    pub(crate) fn make(path: &Path) -> Result<Self> {
        let missing = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
        let made = Self(path.ancestors().take_while(missing).map(Path::to_owned).collect());
        fs::create_dir_all(path).map_err(Error::io("creating", path))?;
        Ok(made)
    }
}

impl Drop for MadeFolders {
    fn drop(&mut self) {
        for folder in &self.0 {
            // Refused if there is anything in it, as there should be. One may not have come to be.
            if fs::remove_dir(folder).is_err_and(|error| error.kind() != ErrorKind::NotFound) {
                break;
            }
        }
    }
}

fn folder(file: &Path) -> &Path {
    file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

fn encode_png(image: &Image, exposure_ev: f32) -> image::ImageResult<Vec<u8>> {
    let bytes = screen(image.pixels.as_flattened().iter(), exposure_ev);
    png_of(image, &bytes, image::ExtendedColorType::Rgb8)
}

/// 8 bits each, sRGB, after an exposure.
fn screen<'a>(linear: impl Iterator<Item = &'a f32>, exposure_ev: f32) -> Vec<u8> {
    let scale = exposure_ev.exp2();
    linear.map(|&linear| (srgb_encode(linear * scale) * 255.0).round() as u8).collect()
}

fn png_of(image: &Image, bytes: &[u8], colour: image::ExtendedColorType) -> image::ImageResult<Vec<u8>> {
    let mut file = Vec::new();
    image::codecs::png::PngEncoder::new(&mut file).write_image(bytes, image.width, image.height, colour)?;
    Ok(file)
}

fn encode_hdr(image: &Image) -> image::ImageResult<Vec<u8>> {
    // The format has no sign; the largest mantissa and exponent make 1.69e38.
    let representable = |v: f32| if v > 0.0 { v.min(1.6e38) } else { 0.0 };
    let pixels: Vec<_> = image.pixels.iter().map(|p| image::Rgb(p.map(representable))).collect();
    let mut file = Vec::new();
    image::codecs::hdr::HdrEncoder::new(&mut file).encode(
        &pixels,
        image.width as usize,
        image.height as usize,
    )?;
    Ok(file)
}

fn encode_exr(image: &Image, variance: Option<&Image>) -> exr::error::Result<Vec<u8>> {
    let layers = [("", Some(image)), ("variance.", variance)];
    let channels =
        layers.iter().filter_map(|&(layer, image)| Some((layer, image?))).flat_map(|(layer, image)| {
            ["R", "G", "B"].into_iter().enumerate().map(move |(c, name)| {
                let samples = image.pixels.iter().map(|p| p[c]).collect();
                openexr::AnyChannel::new(
                    format!("{layer}{name}").as_str(),
                    openexr::FlatSamples::F32(samples),
                )
            })
        });
    let encoding = openexr::Encoding {
        compression: openexr::Compression::ZIP16,
        blocks: openexr::Blocks::ScanLines,
        line_order: openexr::LineOrder::Increasing,
    };
    let layer = openexr::Layer::new(
        (image.width as usize, image.height as usize),
        openexr::LayerAttributes::default(),
        encoding,
        openexr::AnyChannels::sort(channels.collect()),
    );
    let mut file = Cursor::new(Vec::new());
    openexr::Image::from_layer(layer).write().to_buffered(&mut file)?;
    Ok(file.into_inner())
}

/// `PF`, the size, minus one for little endian, then rows from the bottom.
fn encode_pfm(image: &Image) -> Vec<u8> {
    let mut file = format!("PF\n{} {}\n-1.0\n", image.width, image.height).into_bytes();
    file.reserve(image.pixels.len() * 12);
    for row in image.pixels.chunks_exact(image.width as usize).rev() {
        file.extend(row.as_flattened().iter().flat_map(|v| v.to_le_bytes()));
    }
    file
}

fn decode_image(bytes: &[u8], format: image::ImageFormat) -> Decoded<Image> {
    let kind = if format == image::ImageFormat::Png { "PNG" } else { "Radiance HDR" };
    let unreadable = |e: image::ImageError| format!("not a readable {kind} file: {e}");
    let reader = || image::ImageReader::with_format(Cursor::new(bytes), format);
    // Sizes first, as any image that can be written can be read, however large.
    let (width, height) = reader().into_dimensions().map_err(unreadable)?;
    check_size(width.into(), height.into())?;
    // As it is decoded, as floats, and as pixels.
    crate::render::check_room((width, height), 30).map_err(|error| error.to_string())?;
    let mut reader = reader();
    reader.no_limits();
    let decoded = reader.decode().map_err(unreadable)?.into_rgb32f();
    let linear = |v: f32| if format == image::ImageFormat::Png { srgb_decode(v) } else { v };
    let (width, height) = decoded.dimensions();
    Ok(Image { width, height, pixels: decoded.pixels().map(|p| p.0.map(linear)).collect() })
}

fn decode_exr(bytes: &[u8]) -> Decoded<Image> {
    let unreadable = |e: exr::error::Error| format!("not a readable OpenEXR file: {e}");
    // Sizes first: the pixels are allocated from them.
    let meta = exr::meta::MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(unreadable)?;
    for header in &meta.headers {
        check_size(header.layer_size.width() as u64, header.layer_size.height() as u64)?;
    }
    let file = openexr::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        .from_buffered(Cursor::new(bytes))
        .map_err(unreadable)?;
    for names in [["R", "G", "B"], ["Y", "Y", "Y"]] {
        for layer in &file.layer_data {
            let channel = |name: &str| layer.channel_data.list.iter().find(|c| c.name == *name);
            let [Some(r), Some(g), Some(b)] = names.map(channel) else { continue };
            let (width, height) = (layer.size.width(), layer.size.height());
            if [r, g, b].iter().any(|c| c.sample_data.len() != width * height) {
                return Err(
                    "channels of R, G, B or Y with fewer samples than pixels are not supported".into()
                );
            }
            let [r, g, b] = [r, g, b].map(|c| c.sample_data.values_as_f32());
            let pixels = r.zip(g).zip(b).map(|((r, g), b)| [r, g, b]).collect();
            return Ok(Image { width: width as u32, height: height as u32, pixels });
        }
    }
    let found: Vec<_> =
        file.layer_data.iter().flat_map(|l| &l.channel_data.list).map(|c| c.name.to_string()).collect();
    Err(format!("has neither the channels R, G and B nor Y, only {}", found.join(", ")))
}

fn decode_pfm(bytes: &[u8]) -> Decoded<Image> {
    let mut rest = bytes;
    let mut word = || -> Decoded<&str> {
        let start = rest.iter().position(|b| !b.is_ascii_whitespace()).unwrap_or(rest.len());
        let word = &rest[start..];
        let end = word.iter().position(u8::is_ascii_whitespace).ok_or("the PFM header is not complete")?;
        rest = &word[end + 1..]; // one character of space ends the header
        std::str::from_utf8(&word[..end]).map_err(|_| "not a PFM file: its header is not text".into())
    };
    let channels = match word()? {
        "PF" => 3,
        "Pf" => 1,
        other => return Err(format!("not a PFM file: it begins with {other:.8?}, not \"PF\" or \"Pf\"")),
    };
    let [width, height] = [word()?, word()?].map(|w| w.parse::<u32>().ok());
    let (Some(width), Some(height)) = (width, height) else {
        return Err("the PFM header has no width and height".into());
    };
    // Only the sign of the scale has a meaning that everybody agrees on.
    let scale = word()?.parse::<f32>().ok().filter(|s| s.is_finite() && *s != 0.0);
    let little = scale.ok_or("the PFM header has no scale, whose sign says the byte order")? < 0.0;
    check_size(width.into(), height.into())?;
    let (width_bytes, expected) =
        (width as usize * channels * 4, width as usize * height as usize * channels * 4);
    if rest.len() != expected {
        return Err(format!("holds {} bytes of pixels instead of {expected}", rest.len()));
    }
    let value = |b: &[u8]| {
        let b = [b[0], b[1], b[2], b[3]];
        if little { f32::from_le_bytes(b) } else { f32::from_be_bytes(b) }
    };
    let pixel = |b: &[u8]| match channels {
        3 => [value(&b[0..4]), value(&b[4..8]), value(&b[8..12])],
        _ => [value(b); 3],
    };
    let rows = rest.chunks_exact(width_bytes).rev();
    let pixels = rows.flat_map(|row| row.chunks_exact(channels * 4).map(pixel)).collect();
    Ok(Image { width, height, pixels })
}

fn check_size(width: u64, height: u64) -> Decoded<()> {
    if width == 0 || height == 0 {
        return Err("has no pixels".into());
    }
    if width.saturating_mul(height) > MAX_PIXELS {
        return Err(format!("claims {width} x {height} pixels, more than the {MAX_PIXELS} supported"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(width: u32, height: u32) -> Image {
        Image::from_fn(width, height, |x, y| {
            let k = (x * 31 + y * 17) as f32;
            [k.sin().abs() * 3.0, (k * 0.01).exp() * 1e-3, 1.0 / (k + 0.3)]
        })
    }

    /// With what an estimate may be and a screen cannot show.
    fn awkward() -> Image {
        let mut image = picture(13, 7);
        image.pixels[5] = [-1.5, f32::NAN, f32::INFINITY];
        image.pixels[6] = [f32::MIN_POSITIVE / 4.0, f32::MAX, -0.0];
        image
    }

    fn bits(image: &Image) -> (u32, u32, Vec<u32>) {
        (image.width, image.height, image.pixels.as_flattened().iter().map(|v| v.to_bits()).collect())
    }

    #[test]
    fn floats_come_back_bit_by_bit() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.exr", "a.pfm", "upper.EXR"] {
            let path = folder.path().join(name);
            for image in [awkward(), picture(1, 1), picture(70, 40)] {
                write(&path, &image, None, 3.0).unwrap();
                assert_eq!(bits(&read(&path).unwrap()), bits(&image), "{name}");
            }
        }
    }

    #[test]
    fn hdr_keeps_eight_bits_of_the_brightest_channel() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.hdr");
        for image in [picture(70, 40), picture(3, 2)] {
            write(&path, &image, None, 3.0).unwrap();
            for (p, q) in read(&path).unwrap().pixels.iter().zip(&image.pixels) {
                let step = q.iter().fold(0.0f32, |a, b| a.max(*b)) / 128.0;
                assert!((0..3).all(|c| (p[c] - q[c]).abs() <= step), "{p:?} {q:?}");
            }
        }
        write(&path, &awkward(), None, 0.0).unwrap();
        assert!(read(&path).unwrap().pixels.as_flattened().iter().all(|v| v.is_finite() && *v >= 0.0));
    }

    #[test]
    fn png_is_exposed_clamped_and_encoded() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let image = Image::from_fn(256, 1, |x, _| {
            let v = srgb_decode(x as f32 / 255.0);
            [v / 4.0, v, v * 4.0]
        });
        for (channel, ev) in [(0, 2.0), (1, 0.0), (2, -2.0)] {
            write(&path, &image, None, ev).unwrap();
            let back = read(&path).unwrap();
            assert!((0..256).all(|x| back.pixels[x][channel] == image.pixels[x][1]));
        }
        write(&path, &awkward(), None, 0.0).unwrap();
        assert_eq!(read(&path).unwrap().pixels[5], [0.0, 0.0, 1.0]);
    }

    #[test]
    fn the_transfer_curve_has_its_inverse() {
        assert_eq!([0.0, -2.0, f32::NAN].map(srgb_encode), [0.0; 3]);
        assert!([1.0, 2.0, f32::INFINITY].map(srgb_encode).iter().all(|v| (v - 1.0).abs() < 1e-6));
        assert!((srgb_encode(0.5) - 0.735_357).abs() < 1e-6);
        for i in 0..=1000 {
            let v = i as f32 / 1000.0;
            assert!((srgb_decode(srgb_encode(v)) - v).abs() < 1e-6);
        }
    }

    #[test]
    fn variance_is_a_layer_of_the_exr() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let (image, variance) = (picture(9, 5), Image::from_fn(9, 5, |x, _| [x as f32; 3]));
        write(&path, &image, Some(&variance), 0.0).unwrap();
        assert_eq!(read(&path).unwrap(), image);
        let file = openexr::read_all_flat_layers_from_file(&path).unwrap();
        assert_eq!(file.layer_data.len(), 1);
        let channels = &file.layer_data[0].channel_data.list;
        let names: Vec<_> = channels.iter().map(|c| c.name.to_string()).collect();
        assert_eq!(names, ["B", "G", "R", "variance.B", "variance.G", "variance.R"]);
        assert_eq!(channels[5].sample_data.values_as_f32().nth(4), Some(4.0));

        assert!(write(&path, &image, Some(&picture(5, 9)), 0.0).is_err());
    }

    #[test]
    fn half_grey_and_any_order_of_layers_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let layer = |name: &str, channels: &[&str]| {
            let channel = |(i, name): (usize, &&str)| {
                let values = (0..12).map(|k| openexr::f16::from_f32((k + 100 * i) as f32)).collect();
                openexr::AnyChannel::new(*name, openexr::FlatSamples::F16(values))
            };
            openexr::Layer::new(
                (4, 3),
                openexr::LayerAttributes::named(name),
                openexr::Encoding::SMALL_LOSSLESS,
                openexr::AnyChannels::sort(channels.iter().enumerate().map(channel).collect()),
            )
        };
        let write_layers = |layers: Vec<openexr::Layer<_>>| {
            let window = openexr::IntegerBounds::from_dimensions((4, 3));
            openexr::Image::from_layers(openexr::ImageAttributes::new(window), layers)
                .write()
                .to_file(&path)
                .unwrap();
        };
        write_layers(vec![layer("depth", &["Z"]), layer("grey", &["Y"]), layer("beauty", &["R", "G", "B"])]);
        assert_eq!(read(&path).unwrap().pixels[7], [7.0, 107.0, 207.0]);
        write_layers(vec![layer("depth", &["Z"]), layer("grey", &["A", "Y"])]);
        assert_eq!(read(&path).unwrap().pixels[7], [107.0; 3]);
        write_layers(vec![layer("depth", &["Z"])]);
        assert!(read(&path).unwrap_err().to_string().contains("only Z"));
    }

    #[test]
    fn pfm_is_read_in_either_byte_order_grey_or_colour() {
        let grey = [&b"Pf 2\t1\n1.0\n"[..], &1.5f32.to_be_bytes(), &(-2.0f32).to_be_bytes()].concat();
        assert_eq!(decode_pfm(&grey).unwrap().pixels, [[1.5; 3], [-2.0; 3]]);
        // Rows from the bottom; the first byte of a pixel may look like space.
        let rows = [&b"Pf\n1 2\n-2.5\n"[..], &[0x20; 4], &3.0f32.to_le_bytes()].concat();
        assert_eq!(decode_pfm(&rows).unwrap().pixels, [[3.0; 3], [f32::from_le_bytes([0x20; 4]); 3]]);
    }

    #[test]
    fn damaged_files_are_errors_that_name_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let refused = |name: &str, bytes: &[u8]| {
            let path = folder.path().join(name);
            fs::write(&path, bytes).unwrap();
            let error = read(&path).unwrap_err().to_string();
            assert!(error.contains(name), "{error}");
        };
        for name in ["a.exr", "a.hdr", "a.png", "a.pfm"] {
            let path = folder.path().join(name);
            write(&path, &picture(40, 30), None, 0.0).unwrap();
            let whole = fs::read(&path).unwrap();
            for length in [0, 1, 4, 9, 11, 20, whole.len() / 2, whole.len() * 9 / 10] {
                refused(name, &whole[..length]);
            }
            refused(name, b"\n\n\n");
            refused(name, &[0xff; 64]);
        }
        for header in
            ["PF\n0 3\n-1\n", "PF\n-1 3\n-1\n", "PF\n4000000000 4000000000\n-1\n", "PF 1 1 0 ", "P6 1 1 -1 "]
        {
            refused("a.pfm", header.as_bytes());
        }
        assert!(read(folder.path().join("missing.png")).unwrap_err().to_string().contains("missing.png"));
        assert!(read(folder.path()).is_err());
    }

    #[test]
    fn an_unknown_extension_is_told_the_known_ones() {
        for name in ["a.jpg", "a", "", ".png"] {
            let errors = [
                write(name, &picture(2, 2), None, 0.0).unwrap_err(),
                check_writable(name).unwrap_err(),
                read(name).unwrap_err(),
            ];
            for e in errors {
                assert!(
                    matches!(&e, Error::Usage(m) if [".png", ".exr", ".hdr", ".pfm"].iter().all(|x| m.contains(x)))
                );
            }
        }
    }

    #[test]
    fn what_cannot_be_written_is_known_beforehand_and_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let image = picture(4, 4);
        fs::create_dir(folder.path().join("folder.png")).unwrap();
        fs::write(folder.path().join("file"), "").unwrap();
        let locked = folder.path().join("locked.png");
        fs::write(&locked, "kept").unwrap();
        let mut permissions = fs::metadata(&locked).unwrap().permissions();
        permissions.set_readonly(true);
        fs::set_permissions(&locked, permissions).unwrap();
        for (name, why) in [
            ("no/such/a.png", "does not exist"),
            ("folder.png", "is a folder"),
            ("file/a.png", ""),
            ("locked.png", "read-only"),
            ("new.png/", "ends like the name of a folder"),
            ("new.png/.", "ends like the name of a folder"),
        ] {
            let path = folder.path().join(name);
            for error in [check_writable(&path).unwrap_err(), write(&path, &image, None, 0.0).unwrap_err()] {
                let error = error.to_string();
                assert!(error.contains(name) && error.contains(why), "{error}");
            }
        }
        check_writable(folder.path().join("new.exr")).unwrap();
        assert!(write(folder.path().join("none.exr"), &Image::new(0, 3), None, 0.0).is_err());
        assert!(write(folder.path().join("none.exr"), &Image { width: 9, ..image }, None, 0.0).is_err());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 3);
        assert_eq!(fs::read(&locked).unwrap(), b"kept");
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_and_permissions_are_the_usual_ones() {
        use std::os::unix::fs::{PermissionsExt, symlink};
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let mode = |name: &str| fs::metadata(at(name)).unwrap().permissions().mode() & 0o777;
        let image = picture(4, 4);

        fs::write(at("plain"), "").unwrap();
        write(at("new.pfm"), &image, None, 0.0).unwrap();
        assert_eq!(mode("new.pfm"), mode("plain"));

        fs::set_permissions(at("new.pfm"), fs::Permissions::from_mode(0o640)).unwrap();
        write(at("new.pfm"), &picture(5, 5), None, 0.0).unwrap();
        assert_eq!(mode("new.pfm"), 0o640);

        fs::create_dir(at("elsewhere")).unwrap();
        symlink("elsewhere/target.pfm", at("link.pfm")).unwrap();
        for image in [picture(6, 2), picture(2, 6)] {
            check_writable(at("link.pfm")).unwrap();
            write(at("link.pfm"), &image, None, 0.0).unwrap();
            assert_eq!(read(at("elsewhere/target.pfm")).unwrap(), image);
        }
        assert!(fs::symlink_metadata(at("link.pfm")).unwrap().is_symlink());

        symlink("/dev/null", at("null.pfm")).unwrap();
        check_writable(at("null.pfm")).unwrap();
        write(at("null.pfm"), &image, None, 0.0).unwrap();
        assert!(!fs::metadata("/dev/null").unwrap().is_file());

        symlink("round.pfm", at("round.pfm")).unwrap();
        assert!(check_writable(at("round.pfm")).is_err());
    }

    #[cfg(unix)]
    #[test]
    fn a_file_is_itself_by_any_name() {
        use std::os::unix::fs::symlink;
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir(at("in")).unwrap();
        fs::write(at("in/a.map"), "").unwrap();
        symlink("in", at("also")).unwrap();
        symlink("a.map", at("in/link")).unwrap();
        symlink("new.map", at("in/to new")).unwrap();
        symlink("/dev/null", at("null")).unwrap();
        let apart = |outputs: &[&str], inputs: &[&str]| {
            let (outputs, inputs) = (outputs.iter().map(|n| at(n)), inputs.iter().map(|n| at(n)));
            let (outputs, inputs): (Vec<_>, Vec<_>) = (outputs.collect(), inputs.collect());
            fn named(paths: &[PathBuf]) -> Vec<(&str, &Path)> {
                paths.iter().map(|path| ("--it", &**path)).collect()
            }
            check_apart(&named(&outputs), &named(&inputs)).map_err(|e| e.to_string())
        };
        for name in ["in/a.map", "also/a.map", "in/../also/link"] {
            let said = apart(&["b", name], &["c", "in/a.map"]).unwrap_err();
            assert!(said.contains(name) && said.contains("in/a.map, which is read"), "{said}");
        }
        for name in ["in/new.map", "also/new.map", "also/to new"] {
            let said = apart(&["in/new.map", name], &["in/a.map"]).unwrap_err();
            assert!(said.contains(name) && said.contains("name two files"), "{said}");
        }
        apart(&["null", "null", "in/b", "c"], &["null", "in/a.map", "in/a.map", "gone/a"]).unwrap();
    }
}
