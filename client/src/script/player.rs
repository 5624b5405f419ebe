//! Does what a script says.

use std::collections::{BTreeSet, VecDeque};

use mr360_protocol::clock::ClientTime;
use mr360_protocol::intent::{Action, Motion};
use mr360_protocol::scene::ObjectId;

use super::Deed;
use crate::frame_loop::Stage;
use crate::hands::{Hands, HandsInput};

/// A script under way. It begins when it is first asked.
pub struct Player {
    deeds: VecDeque<Deed>,
    begin: Option<ClientTime>,
    hands: Hands,
    /// What the script has taken hold of.
    held: BTreeSet<ObjectId>,
    over: bool,
    act: Box<dyn FnMut(Action) + Send>,
}

impl Player {
    /// `act` hands wishes on to the server and must not block.
    #[must_use]
    pub fn new(deeds: Vec<Deed>, act: Box<dyn FnMut(Action) + Send>) -> Self {
        Self { deeds: deeds.into(), begin: None, hands: Hands::default(), held: BTreeSet::new(), over: false, act }
    }

    /// Does all that is due. Hands see the time of the script, so that what they throw flies as it did. At its end it lets go of what it
    /// holds, and its hands are gone.
    pub fn play(&mut self, stage: &mut impl Stage, now: ClientTime) {
        let begin = self.begin.get_or_insert(now).0;
        while let Some(deed) = self.deeds.pop_front_if(|deed| begin.saturating_add(deed.at().0) <= now.0) {
            match deed {
                Deed::Action(_, action) => self.wish(stage, action, now),
                Deed::Hands(input) => {
                    let input = HandsInput { now: ClientTime(begin.saturating_add(input.now.0)), ..input };
                    let out = self.hands.update(&input, stage);
                    out.actions.into_iter().for_each(|action| self.wish(stage, action, now));
                    stage.show_script(&out.drawn);
                }
            }
        }
        if self.deeds.is_empty() && !std::mem::replace(&mut self.over, true) {
            for object in std::mem::take(&mut self.held) {
                self.wish(stage, Action::Release(object, Motion::STILL), now);
            }
            stage.show_script(&[]);
        }
    }

    fn wish(&mut self, stage: &mut impl Stage, action: Action, now: ClientTime) {
        match action {
            Action::Grab(object) | Action::Move(object, _) => _ = self.held.insert(object),
            Action::Release(object, _) | Action::Remove(object) => _ = self.held.remove(&object),
            Action::Put { .. } => {}
        }
        stage.predict(&action, now);
        (self.act)(action);
    }
}
