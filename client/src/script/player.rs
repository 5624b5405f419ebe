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

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use mr360_protocol::light::LightFrame;

    use super::*;
    use crate::frame_loop::{Drawn, FrameError, Shot};
    use crate::hands::{HandInput, LocalObject, Pose, World};
    use crate::sync::Paired;

    /// Keeps how many objects a script shows.
    #[derive(Default)]
    struct Shows(Vec<usize>);

    impl World for Shows {}

    impl Stage for Shows {
        fn prepare(&mut self) -> Result<bool, FrameError> {
            Ok(false)
        }
        fn update(&mut self, _paired: Paired) -> Result<(), FrameError> {
            Ok(())
        }
        fn relight(&mut self, _light: &LightFrame) -> bool {
            false
        }
        fn draw(&mut self, _shots: &[Shot]) -> Result<Drawn, FrameError> {
            Ok(Drawn::default())
        }
        fn device_lost(&self) -> Option<String> {
            None
        }
        fn has_scene(&self) -> bool {
            true
        }
        fn predict(&mut self, _action: &Action, _now: ClientTime) {}
        fn show_local(&mut self, _objects: &[LocalObject]) {
            panic!("that is for the user's own hands");
        }
        fn show_script(&mut self, objects: &[LocalObject]) {
            self.0.push(objects.len());
        }
    }

    fn play(deeds: Vec<Deed>, times: &[u64]) -> (Vec<Action>, Vec<usize>) {
        let (wished, actions) = channel();
        let mut player = Player::new(deeds, Box::new(move |action| wished.send(action).unwrap()));
        let mut stage = Shows::default();
        times.iter().for_each(|at| player.play(&mut stage, ClientTime(*at)));
        (actions.try_iter().collect(), stage.0)
    }

    #[test]
    fn a_script_that_ends_lets_go_once_and_its_hands_are_gone() {
        let hand = HandInput { grip: Some(Pose::IDENTITY), ..HandInput::default() };
        let hands = HandsInput { hands: [hand; 2], head: Pose::IDENTITY, now: ClientTime(20), scale: 1.0 };
        let [kept, dropped] = [ObjectId(1), ObjectId(2)];
        let deeds = vec![
            Deed::Action(ClientTime(0), Action::Grab(kept)),
            Deed::Action(ClientTime(0), Action::Grab(dropped)),
            Deed::Action(ClientTime(10), Action::Release(dropped, Motion::STILL)),
            Deed::Hands(hands),
        ];
        let (actions, shown) = play(deeds, &[500, 510, 519, 520, 530]);
        let release = |object| Action::Release(object, Motion::STILL);
        assert_eq!(actions, [Action::Grab(kept), Action::Grab(dropped), release(dropped), release(kept)]);
        assert_eq!(shown, [2, 0]);
    }

    #[test]
    fn what_is_never_due_is_never_done() {
        let late = Deed::Action(ClientTime(u64::MAX), Action::Grab(ObjectId(1)));
        assert_eq!(play(vec![late], &[1_000, 2_000]), (Vec::new(), Vec::new()));
    }
}
