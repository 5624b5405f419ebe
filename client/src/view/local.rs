//! Objects of this viewer alone, hands and rays: drawn like all others, but nobody else has them, and they cannot be picked.

use mr360_protocol::scene::{FIRST_LOCAL_ID as FIRST_LOCAL, ObjectId};

/// Most of each kind.
pub const MAX_LOCAL: u32 = (u32::MAX - FIRST_LOCAL) / 2;

/// The id of the so manieth local object, below [`MAX_LOCAL`].
#[must_use]
pub fn local_id(index: u32, casts: bool) -> ObjectId {
    ObjectId(FIRST_LOCAL + index.min(MAX_LOCAL - 1) + if casts { 0 } else { MAX_LOCAL })
}

pub(super) fn is_local(id: ObjectId) -> bool {
    id.0 >= FIRST_LOCAL
}

/// It throws shadows and hides light from others.
pub(super) fn casts(id: ObjectId) -> bool {
    id.0 < FIRST_LOCAL + MAX_LOCAL
}
