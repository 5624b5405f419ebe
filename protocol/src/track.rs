//! Names and priorities of the tracks of a broadcast `mr360/<room>`.

use std::time::Duration;

use moq_net::Timescale;
use moq_net::track::{Info, Subscription};

/// H.264, HEVC or AV1 access units in the hang container, one group per GOP.
pub const VIDEO: &str = "video";
/// Opus or AAC in the hang container.
pub const AUDIO: &str = "audio";
/// One group per video frame, holding one [`LightFrame`](crate::light::LightFrame).
pub const LIGHT: &str = "light";
/// A snapshot of the shared scene, then deltas.
pub const SCENE: &str = "scene";
/// A user's wishes for the scene; on the user's own broadcast.
pub const INTENT: &str = "intent";
/// A user's head pose; on the user's own broadcast.
pub const POSE: &str = "pose";

/// Above every media track of hang (catalog 100): light is a few hundred bytes and every pixel waits for it.
const LIGHT_PRIORITY: u8 = 110;
/// Longest time that a picture waits for its light: the playout buffer's bound.
const LIGHT_MAX_AGE: Duration = Duration::from_millis(500);
/// As above, for the media themselves.
const MEDIA_MAX_AGE: Duration = Duration::from_millis(500);
/// The scene is small and rare.
const SCENE_PRIORITY: u8 = 105;
/// Wishes of one drag are not given up for those of the next until they are this late.
const INTENT_MAX_AGE: Duration = Duration::from_secs(2);
/// Assets are large; they must not hold up the video.
const ASSET_PRIORITY: u8 = 20;

/// How the light track is published.
#[must_use]
pub fn light_info() -> Info {
    Info::default().with_priority(LIGHT_PRIORITY).with_timescale(Timescale::MICRO).with_max_age(LIGHT_MAX_AGE)
}

/// How the light track is subscribed: every frame's light is wanted for as long as its picture may wait for it.
#[must_use]
pub fn light_subscription() -> Subscription {
    Subscription::default().with_priority(LIGHT_PRIORITY).with_max_age(LIGHT_MAX_AGE)
}

/// How media tracks are subscribed: late groups are given up once the playout has moved past them.
#[must_use]
pub fn media_subscription(priority: u8) -> Subscription {
    Subscription::default().with_priority(priority).with_max_age(MEDIA_MAX_AGE)
}

/// How the scene track is published.
#[must_use]
pub fn scene_info() -> Info {
    Info::default().with_priority(SCENE_PRIORITY)
}

/// How the scene track is subscribed: the newest group starts with all that is needed.
#[must_use]
pub fn scene_subscription() -> Subscription {
    Subscription::default().with_priority(SCENE_PRIORITY)
}

/// How a user's intents are subscribed.
#[must_use]
pub fn intent_subscription() -> Subscription {
    scene_subscription().with_max_age(INTENT_MAX_AGE)
}

/// How an asset track is subscribed.
#[must_use]
pub fn asset_subscription() -> Subscription {
    Subscription::default().with_priority(ASSET_PRIORITY)
}

/// How an asset track is published.
#[must_use]
pub fn asset_info() -> Info {
    Info::default().with_priority(ASSET_PRIORITY)
}

/// Path of a room's broadcast.
#[must_use]
pub fn broadcast_path(room: &str) -> String {
    format!("mr360/{room}")
}

/// Path of a user's own broadcast in a room.
#[must_use]
pub fn user_path(room: &str, user: &str) -> String {
    format!("mr360/{room}/user/{user}")
}

/// Most characters in a room's name.
pub const MAX_ROOM_CHARS: usize = 64;

/// True for names of 1 to [`MAX_ROOM_CHARS`] characters out of `a–z A–Z 0–9 - _`.
#[must_use]
pub fn is_valid_room(room: &str) -> bool {
    (1..=MAX_ROOM_CHARS).contains(&room.len()) && room.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_')
}
