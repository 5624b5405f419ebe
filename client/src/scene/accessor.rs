//! Numbers out of a glTF file's buffers, with every bound checked.

use std::borrow::Cow;

use gltf::accessor::{DataType, Dimensions};

use super::model::ModelError;

/// Most numbers in one accessor, components of all its elements together.
pub const MAX_NUMBERS: usize = 16_000_000;

/// The elements of an accessor as floats, `N` each; normalised integers become fractions, others their value.
///
/// # Errors
/// [`ModelError`] naming the accessor, when it has another number of components, lies outside of its buffer,
/// holds too much, or a value is not finite.
pub fn floats<const N: usize>(
    accessor: &gltf::Accessor<'_>,
    buffers: &[Cow<'_, [u8]>],
    used_as: &'static str,
) -> Result<Vec<[f32; N]>, ModelError> {
    let fault = |fault: String| ModelError::Accessor { index: accessor.index(), used_as, fault };
    if accessor.dimensions().multiplicity() != N || matches!(accessor.dimensions(), Dimensions::Mat2 | Dimensions::Mat3) {
        return Err(fault(format!("{:?} where {N} components are expected", accessor.dimensions())));
    }
    let elements = Elements::of::<N>(accessor, buffers).map_err(fault)?;
    let mut out = vec![[0.0; N]; accessor.count()];
    if let Some(elements) = elements {
        for (i, element) in out.iter_mut().enumerate() {
            *element = elements.get(i).and_then(|bytes| values(bytes, accessor)).ok_or_else(|| fault(elements.beyond(i)))?;
        }
    }
    if let Some(sparse) = accessor.sparse() {
        overlay(&sparse, accessor, buffers, &mut out)
            .ok_or_else(|| fault("sparse values or indices lie outside of their buffer or of the accessor".to_owned()))?;
    }
    if let Some(i) = out.iter().position(|element| element.iter().any(|value| !value.is_finite())) {
        return Err(fault(format!("element {i} is not finite")));
    }
    Ok(out)
}

/// The elements of an accessor of unsigned integers, `N` each, exactly.
///
/// # Errors
/// As [`floats`], and for signed or floating components.
pub fn integers<const N: usize>(
    accessor: &gltf::Accessor<'_>,
    buffers: &[Cow<'_, [u8]>],
    used_as: &'static str,
) -> Result<Vec<[u32; N]>, ModelError> {
    let fault = |fault: String| ModelError::Accessor { index: accessor.index(), used_as, fault };
    if accessor.dimensions().multiplicity() != N || !matches!(accessor.data_type(), DataType::U8 | DataType::U16 | DataType::U32) {
        return Err(fault(format!("{:?} of {:?} where {N} unsigned integers are expected", accessor.dimensions(), accessor.data_type())));
    }
    if accessor.sparse().is_some() {
        return Err(fault("sparse; export it without".to_owned()));
    }
    let Some(elements) = Elements::of::<N>(accessor, buffers).map_err(fault)? else { return Ok(vec![[0; N]; accessor.count()]) };
    let element = |i: usize| {
        let mut out = [0; N];
        for (to, component) in out.iter_mut().zip(elements.get(i)?.chunks_exact(accessor.data_type().size())) {
            *to = component.iter().rev().fold(0, |value, byte| value << 8 | u32::from(*byte));
        }
        Some(out)
    };
    (0..accessor.count()).map(|i| element(i).ok_or_else(|| fault(elements.beyond(i)))).collect()
}

/// Where an accessor's elements lie.
struct Elements<'a> {
    bytes: &'a [u8],
    offset: usize,
    stride: usize,
    size: usize,
    count: usize,
    view: usize,
}

impl<'a> Elements<'a> {
    /// Checked to be there to the last one, before anything is allocated for them; `None` where all are zero.
    fn of<const N: usize>(accessor: &gltf::Accessor<'_>, buffers: &'a [Cow<'_, [u8]>]) -> Result<Option<Self>, String> {
        let count = accessor.count();
        if count.saturating_mul(N) > MAX_NUMBERS {
            return Err(format!("{count} elements, at most {}", MAX_NUMBERS / N));
        }
        let Some(view) = accessor.view() else { return Ok(None) };
        let bytes = slice(&view, buffers)
            .ok_or_else(|| format!("buffer view {} lies outside of buffer {}", view.index(), view.buffer().index()))?;
        let size = accessor.data_type().size() * N;
        let elements = Self { bytes, offset: accessor.offset(), stride: view.stride().unwrap_or(size), size, count, view: view.index() };
        match count.checked_sub(1) {
            Some(last) if elements.get(last).is_none() => Err(elements.beyond(last)),
            _ => Ok(Some(elements)),
        }
    }

    fn get(&self, i: usize) -> Option<&'a [u8]> {
        let at = i.checked_mul(self.stride)?.checked_add(self.offset)?;
        self.bytes.get(at..at.checked_add(self.size)?)
    }

    fn beyond(&self, i: usize) -> String {
        format!("element {i} of {} lies outside of buffer view {} of {} bytes", self.count, self.view, self.bytes.len())
    }
}

/// The bytes of a buffer view.
pub(crate) fn slice<'a>(view: &gltf::buffer::View<'_>, buffers: &'a [Cow<'_, [u8]>]) -> Option<&'a [u8]> {
    buffers.get(view.buffer().index())?.get(view.offset()..view.offset().checked_add(view.length())?)
}

/// The components of one element.
fn values<const N: usize>(bytes: &[u8], accessor: &gltf::Accessor<'_>) -> Option<[f32; N]> {
    let mut out = [0.0; N];
    for (to, component) in out.iter_mut().zip(bytes.chunks_exact(accessor.data_type().size())) {
        *to = component_value(component, accessor.data_type(), accessor.normalized())?;
    }
    Some(out)
}

/// glTF 2.0, Sec. 3.6.2.2 and "Animations" for normalised integers.
fn component_value(bytes: &[u8], data_type: DataType, normalized: bool) -> Option<f32> {
    let scaled = |value: f32, largest: f32| if normalized { (value / largest).max(-1.0) } else { value };
    Some(match data_type {
        DataType::I8 => scaled(f32::from(i8::from_le_bytes(bytes.try_into().ok()?)), 127.0),
        DataType::U8 => scaled(f32::from(*bytes.first()?), 255.0),
        DataType::I16 => scaled(f32::from(i16::from_le_bytes(bytes.try_into().ok()?)), 32_767.0),
        DataType::U16 => scaled(f32::from(u16::from_le_bytes(bytes.try_into().ok()?)), 65_535.0),
        DataType::U32 => scaled(u32::from_le_bytes(bytes.try_into().ok()?) as f32, u32::MAX as f32),
        DataType::F32 => f32::from_le_bytes(bytes.try_into().ok()?),
    })
}

fn overlay<const N: usize>(
    sparse: &gltf::accessor::sparse::Sparse<'_>,
    accessor: &gltf::Accessor<'_>,
    buffers: &[Cow<'_, [u8]>],
    out: &mut [[f32; N]],
) -> Option<()> {
    use gltf::accessor::sparse::IndexType;
    let (indices, values) = (sparse.indices(), sparse.values());
    let index_bytes = slice(&indices.view(), buffers)?;
    let value_bytes = slice(&values.view(), buffers)?;
    let size = match indices.index_type() {
        IndexType::U8 => 1,
        IndexType::U16 => 2,
        IndexType::U32 => 4,
    };
    let element = accessor.data_type().size() * N;
    for i in 0..sparse.count() {
        let start = indices.offset().checked_add(i.checked_mul(size)?)?;
        let index =
            index_bytes.get(start..start.checked_add(size)?)?.iter().rev().fold(0usize, |value, byte| value << 8 | usize::from(*byte));
        let at = i.checked_mul(element)?.checked_add(values.offset())?;
        *out.get_mut(index)? = self::values(value_bytes.get(at..at.checked_add(element)?)?, accessor)?;
    }
    Some(())
}
