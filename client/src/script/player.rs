//! Does what a script says.

use std::collections::VecDeque;

use mr360_protocol::clock::ClientTime;
use mr360_protocol::intent::Action;

use super::Deed;
use crate::frame_loop::Stage;
use crate::hands::{Hands, HandsInput};

/// A script under way. It begins when it is first asked.
pub struct Player {
    deeds: VecDeque<Deed>,
    begin: Option<ClientTime>,
    hands: Hands,
    act: Box<dyn FnMut(Action) + Send>,
}

impl Player {
    /// `act` hands wishes on to the server and must not block.
    #[must_use]
    pub fn new(deeds: Vec<Deed>, act: Box<dyn FnMut(Action) + Send>) -> Self {
        Self { deeds: deeds.into(), begin: None, hands: Hands::default(), act }
    }

    /// Does all that is due. Hands see the time of the script, so that what they throw flies as it did.
    pub fn play(&mut self, stage: &mut impl Stage, now: ClientTime) {
        let begin = self.begin.get_or_insert(now).0;
        while let Some(deed) = self.deeds.pop_front_if(|deed| begin + deed.at().0 <= now.0) {
            match deed {
                Deed::Action(_, action) => self.wish(stage, action, now),
                Deed::Hands(input) => {
                    let input = HandsInput { now: ClientTime(begin + input.now.0), ..input };
                    let out = self.hands.update(&input, stage);
                    out.actions.into_iter().for_each(|action| self.wish(stage, action, now));
                    stage.show_local(&out.drawn);
                }
            }
        }
    }

    fn wish(&mut self, stage: &mut impl Stage, action: Action, now: ClientTime) {
        stage.predict(&action, now);
        (self.act)(action);
    }
}
