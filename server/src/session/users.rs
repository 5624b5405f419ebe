//! Users as they come and go, and what they wish for.

use std::collections::HashMap;
use std::time::Duration;

use mr360_protocol::codec::Message;
use mr360_protocol::intent::Intent;
use mr360_protocol::scene::{MAX_NAME_CHARS, MAX_USERS};
use mr360_protocol::track;
use tokio::sync::mpsc;

/// Before a user whose intents ended, though the user did not leave, is read anew.
const READ_AGAIN: Duration = Duration::from_millis(100);

/// What the session hears.
pub(super) enum Event {
    /// A wish.
    Intent(String, Intent),
    /// Somebody is gone.
    Left(String),
}

/// Tells of every user of the room until the origin or the session ends.
pub(super) async fn follow_users(origin: moq_net::origin::Consumer, room: String, events: mpsc::Sender<Event>) {
    let prefix = track::user_path(&room, "");
    let mut users: HashMap<String, tokio::task::JoinHandle<()>> = HashMap::new();
    let mut announced = origin.announced();
    while let Some(update) = announced.next().await {
        let path = update.prefix.to_string();
        let Some(user) = path.strip_prefix(&prefix).filter(|user| is_valid_user(user)).map(str::to_owned) else { continue };
        if !update.kind.is_active() {
            if let Some(reader) = users.remove(&user) {
                reader.abort();
                // Until it has ended it may still hand on an intent, which would take hold of an object for a user who is gone.
                let _ = reader.await;
                // The session has ended with its receiver; so does this loop at the next announcement.
                let _ = events.send(Event::Left(user)).await;
            }
            continue;
        }
        if users.contains_key(&user) {
            // The same viewer on a new connection, or another one under the same name: its reader goes on with whoever is left.
            tracing::info!(user, "announced again; one connection of a name is heard at a time");
            continue;
        }
        if users.len() >= MAX_USERS {
            tracing::warn!(user, "refused: a session holds at most {MAX_USERS} users");
            continue;
        }
        tracing::info!(user, "user joined the session");
        let (origin, events, name) = (origin.clone(), events.clone(), user.clone());
        users.insert(
            user,
            tokio::spawn(async move {
                // A connection that is replaced by another one of the same name ends the track, but the user is still announced.
                while !events.is_closed() {
                    match read_intents(&origin, &path, &name, &events).await {
                        Ok(()) => tracing::debug!(user = name, "the user's intents ended; reading them anew"),
                        Err(error) => tracing::debug!(user = name, %error, "the user's intents broke off; reading them anew"),
                    }
                    tokio::time::sleep(READ_AGAIN).await;
                }
            }),
        );
    }
}

async fn read_intents(
    origin: &moq_net::origin::Consumer,
    path: &str,
    user: &str,
    events: &mpsc::Sender<Event>,
) -> Result<(), moq_net::Error> {
    let broadcast = origin.request_broadcast(path).await?;
    let mut track = broadcast.track(track::INTENT)?.subscribe(track::intent_subscription()).await?;
    while let Some(mut group) = track.recv_group().await? {
        while let Some(frame) = group.read_frame().await? {
            match Intent::from_wire(&frame.payload) {
                Ok(intent) => {
                    if events.send(Event::Intent(user.to_owned(), intent)).await.is_err() {
                        return Ok(());
                    }
                }
                Err(error) => tracing::warn!(user, %error, "intent dropped"),
            }
        }
    }
    Ok(())
}

fn is_valid_user(user: &str) -> bool {
    (1..=MAX_NAME_CHARS).contains(&user.len()) && user.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_')
}
