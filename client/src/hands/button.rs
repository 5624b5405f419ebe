//! Buttons that do not chatter.

use mr360_protocol::clock::ClientTime;

/// Pressed from here on.
const PRESS: f32 = 0.6;
/// Let go of from here on.
const LET_GO: f32 = 0.35;
/// A menu button that is held longer means something else, microseconds.
const LONG_US: u64 = 700_000;

/// What became of a button.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Edge {
    None,
    Pressed,
    Released,
}

/// An analogue button with hysteresis.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Trigger {
    pub(super) down: bool,
}

impl Trigger {
    /// 0 to 1; what is no number is taken as before.
    pub(super) fn update(&mut self, value: f32) -> Edge {
        let down = if self.down { value >= LET_GO || value.is_nan() } else { value > PRESS };
        match (std::mem::replace(&mut self.down, down), down) {
            (false, true) => Edge::Pressed,
            (true, false) => Edge::Released,
            _ => Edge::None,
        }
    }
}

/// What a menu button says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Press {
    None,
    Short,
    Long,
}

/// A button whose short and long press differ. The long one is told while the button is still down.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Menu {
    since: Option<ClientTime>,
    told: bool,
}

impl Menu {
    /// Calls off a press that is under way, as nobody knows how long it went on: it is neither short nor long.
    pub(super) fn unknown(&mut self) {
        self.told = true;
    }

    pub(super) fn update(&mut self, down: bool, now: ClientTime) -> Press {
        match (self.since, down) {
            (None, true) => {
                (self.since, self.told) = (Some(now), false);
                Press::None
            }
            (Some(since), true) if !self.told && now.0.saturating_sub(since.0) >= LONG_US => {
                self.told = true;
                Press::Long
            }
            (Some(_), false) => {
                self.since = None;
                if self.told { Press::None } else { Press::Short }
            }
            _ => Press::None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trigger_that_trembles_is_pressed_once() {
        let mut trigger = Trigger::default();
        let edges: Vec<_> = [0.0, 0.5, 0.61, 0.5, 0.62, 0.4, f32::NAN, 0.6, 0.34, 0.5, 0.59].map(|v| trigger.update(v)).to_vec();
        assert_eq!(edges.iter().filter(|edge| **edge == Edge::Pressed).count(), 1);
        assert_eq!(edges.iter().position(|edge| *edge == Edge::Released), Some(8));
    }

    #[test]
    fn a_menu_press_is_short_or_long_and_told_once() {
        let mut menu = Menu::default();
        let mut at = |down, ms: u64| menu.update(down, ClientTime(ms * 1000));
        assert_eq!([at(true, 0), at(true, 500), at(false, 600)], [Press::None, Press::None, Press::Short]);
        assert_eq!([at(true, 1000), at(true, 1700), at(true, 2500), at(false, 2600)], [Press::None, Press::Long, Press::None, Press::None]);
    }

    #[test]
    fn a_menu_press_that_is_lost_sight_of_is_none_and_the_next_is_one() {
        let at = |menu: &mut Menu, down, ms: u64| menu.update(down, ClientTime(ms * 1000));
        for down_again in [false, true] {
            let mut menu = Menu::default();
            assert_eq!(at(&mut menu, true, 0), Press::None);
            menu.unknown();
            let after = [at(&mut menu, down_again, 900), at(&mut menu, down_again, 2000), at(&mut menu, false, 2100)];
            assert_eq!(after, [Press::None; 3], "down again: {down_again}");
            // Lost while it is up it calls nothing off.
            menu.unknown();
            assert_eq!([at(&mut menu, true, 3000), at(&mut menu, false, 3100)], [Press::None, Press::Short]);
        }
    }
}
