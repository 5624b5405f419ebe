//! Hardware decoding: devices that FFmpeg can open for a codec, and the way back to system memory.
#![expect(unsafe_code, reason = "ffmpeg-next has no safe API for hardware devices and hardware frames")]

use std::ffi::CStr;
use std::ptr;

use ffmpeg_next as ffmpeg;
use ffmpeg_next::ffi;

/// Configurations a codec may list; FFmpeg's longest list has eight.
const MAX_CONFIGURATIONS: i32 = 32;

/// An open hardware device.
pub(super) struct Device {
    reference: *mut ffi::AVBufferRef,
    name: String,
}

impl Device {
    /// Opens the first device that works and that the decoder can use; otherwise says what was tried.
    pub(super) fn open_for(decoder: &ffmpeg::Codec) -> Result<Self, String> {
        let mut refusals = Vec::new();
        for index in 0..MAX_CONFIGURATIONS {
            // SAFETY: the codec is one of FFmpeg's static ones; an index past the end gives null, which ends the loop.
            let Some(configuration) = (unsafe { ffi::avcodec_get_hw_config(decoder.as_ptr(), index).as_ref() }) else { break };
            if configuration.methods & ffi::AV_CODEC_HW_CONFIG_METHOD_HW_DEVICE_CTX as i32 == 0 {
                continue;
            }
            match Self::open(configuration.device_type) {
                Ok(device) => return Ok(device),
                Err(refusal) => refusals.push(refusal),
            }
        }
        if refusals.is_empty() {
            return Err(format!("FFmpeg's {} offers no hardware decoding", decoder.name()));
        }
        Err(format!("no device of the kinds FFmpeg's {} can use: {}", decoder.name(), refusals.join(", ")))
    }

    fn open(kind: ffi::AVHWDeviceType) -> Result<Self, String> {
        // SAFETY: the name is a static string, or null for an unknown type.
        let name = unsafe {
            let name = ffi::av_hwdevice_get_type_name(kind);
            if name.is_null() { "unnamed".to_owned() } else { CStr::from_ptr(name).to_string_lossy().into_owned() }
        };
        let mut reference = ptr::null_mut();
        // SAFETY: `reference` is written only on success; null asks for the default device without options.
        let result = unsafe { ffi::av_hwdevice_ctx_create(&mut reference, kind, ptr::null(), ptr::null_mut(), 0) };
        if result < 0 { Err(format!("{name} ({})", ffmpeg::Error::from(result))) } else { Ok(Self { reference, name }) }
    }

    /// FFmpeg's name of the kind of device.
    pub(super) fn name(&self) -> &str {
        &self.name
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        // SAFETY: the reference is ours alone, or null when it was handed on; FFmpeg takes both.
        unsafe { ffi::av_buffer_unref(&mut self.reference) }
    }
}

/// Gives the device to a codec context that is not open yet. FFmpeg's own choice of format then prefers the device and falls
/// back to software for streams that it cannot decode.
pub(super) fn attach(context: &mut ffmpeg::codec::Context, mut device: Device) {
    // SAFETY: the context is valid and not open; it takes over the reference and frees it with itself.
    unsafe { (*context.as_mut_ptr()).hw_device_ctx = std::mem::replace(&mut device.reference, ptr::null_mut()) }
}

/// True when the samples lie in the device's memory.
pub(super) fn is_on_device(frame: &ffmpeg::frame::Video) -> bool {
    // SAFETY: the frame is valid; the field is only compared with null.
    unsafe { !(*frame.as_ptr()).hw_frames_ctx.is_null() }
}

/// Copies a frame from the device into system memory, in the format that the device offers first.
pub(super) fn download(frame: &ffmpeg::frame::Video) -> Result<ffmpeg::frame::Video, ffmpeg::Error> {
    let mut copy = ffmpeg::frame::Video::empty();
    // SAFETY: both frames are valid and distinct; FFmpeg allocates the buffers of the empty one.
    let result = unsafe { ffi::av_hwframe_transfer_data(copy.as_mut_ptr(), frame.as_ptr(), 0) };
    if result < 0 {
        return Err(ffmpeg::Error::from(result));
    }
    copy.set_pts(frame.pts());
    Ok(copy)
}
