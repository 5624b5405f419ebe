//! The broadcast `mr360/<room>`: catalog, media, light, scene and assets as MoQ tracks.

mod assets;
mod light;
mod media;
mod scene;

pub use assets::{AssetError, Assets};
pub use light::{LightTrack, PublishError};
pub use media::{MediaError, MediaTracks};
pub use scene::SceneTrack;

use std::time::Duration;

use mr360_protocol::track;
use mr360_protocol::video::{CatalogExtension, CatalogSection, Colour, StereoLayout};

/// Groups of media older than this are not kept: viewers are live, and nobody seeks.
const MEDIA_RETENTION: Duration = Duration::from_secs(4);

type Catalog = moq_mux::catalog::Producer<CatalogExtension>;

/// A broadcast that viewers can find. It is announced at once, before its source has come, so that they can
/// tell a room that waits from a room that does not exist.
pub struct Broadcast {
    producer: moq_net::broadcast::Producer,
    catalog: Catalog,
    assets: Vec<moq_net::track::Producer>,
}

impl Broadcast {
    /// Creates and announces the room's broadcast.
    ///
    /// # Errors
    /// When the origin refuses the path or the catalog cannot be published.
    pub fn create(origin: &moq_net::origin::Producer, room: &str, method: &str) -> Result<Self, moq_mux::Error> {
        let mut producer = origin.create_broadcast(track::broadcast_path(room))?;
        let config = moq_mux::catalog::Config::default().with_catalog(hang::Catalog::default()).with_max_age(MEDIA_RETENTION);
        let mut catalog = Catalog::new(&mut producer, config)?;
        catalog.mutate(|catalog| {
            catalog.ext.mr360 = Some(CatalogSection {
                version: CatalogSection::VERSION,
                stereo: StereoLayout::Mono,
                colour: Colour::default(),
                video: None,
                method: method.to_owned(),
                light: track::LIGHT.to_owned(),
                scene: track::SCENE.to_owned(),
            });
        })?;
        producer.announce(moq_net::origin::Route::default())?;
        Ok(Self { producer, catalog, assets: Vec::new() })
    }

    /// The light track. Call once.
    ///
    /// # Errors
    /// When there is one already.
    pub fn light(&self) -> Result<LightTrack, moq_net::Error> {
        Ok(LightTrack::new(self.producer.create_track(track::LIGHT, track::light_info())?))
    }

    /// The scene track. Call once.
    ///
    /// # Errors
    /// When there is one already.
    pub fn scene(&self) -> Result<SceneTrack, moq_net::Error> {
        Ok(SceneTrack::new(self.producer.create_track(track::SCENE, track::scene_info())?))
    }

    /// Publishes every asset, each on a track named by its hash.
    ///
    /// # Errors
    /// When an asset is published already.
    pub fn publish_assets(&mut self, assets: &Assets) -> Result<(), moq_net::Error> {
        self.assets = assets.publish(&self.producer)?;
        Ok(())
    }

    /// The media tracks, which come and go with the source.
    #[must_use]
    pub fn media(&self) -> MediaTracks {
        MediaTracks::new(self.producer.clone(), self.catalog.clone())
    }
}
