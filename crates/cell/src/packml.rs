//! Modes and states of the cell after PackML (ISA-TR88.00.02): their names and numbers, and which command is legal in which state.
//!
//! The safety PLC owns the emergency stop. Here it is only observed: [`Machine::abort`] follows it, and the way back is the standard's:
//! clear, reset, and a start of its own. Nothing moves by itself after any of them but the last.
//!
//! ```
//! use cell::packml::{Command, Machine, State};
//! let mut machine = Machine::new();
//! assert_eq!(machine.state(), State::Stopped);
//! machine.command(Command::Reset)?;
//! machine.done(); // resetting is finished
//! machine.command(Command::Start)?;
//! machine.done();
//! assert_eq!((machine.state(), machine.state().number()), (State::Execute, 6));
//! machine.abort(); // the safety chain has opened
//! machine.done();
//! assert!(machine.command(Command::Start).is_err());
//! # Ok::<(), cell::packml::Illegal>(())
//! ```

use serde::{Deserialize, Serialize};
use std::fmt;

/// A mode with its number in the standard.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// Takes units apart.
    Production = 1,
    /// Calibration, verification, cleaning: one action at a time, asked for.
    Maintenance = 2,
    /// By hand at the pendant: the program moves nothing.
    Manual = 3,
}

macro_rules! states {
    ($($(#[$doc:meta])* $name:ident = $number:literal;)*) => {
        /// A state with its number in the standard.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
        #[serde(rename_all = "snake_case")]
        pub enum State { $($(#[$doc])* $name = $number,)* }
        impl State {
            /// Every state, by number.
            pub const ALL: [State; 17] = [$(State::$name,)*];
            /// The standard's name.
            pub fn name(self) -> &'static str {
                match self { $(State::$name => stringify!($name),)* }
            }
        }
    };
}
states! {
    /// Faults are being cleared.
    Clearing = 1;
    /// At rest; a reset leads on.
    Stopped = 2;
    /// Getting ready to work.
    Starting = 3;
    /// Ready; waits for a start.
    Idle = 4;
    /// Waits for something from outside: no unit comes.
    Suspended = 5;
    /// Works.
    Execute = 6;
    /// Coming to rest.
    Stopping = 7;
    /// Coming to rest at once: the safety chain has opened, or an arm is in alarm.
    Aborting = 8;
    /// At rest after that; has to be cleared.
    Aborted = 9;
    /// Coming to a hold.
    Holding = 10;
    /// Held: a person or the program itself asked to wait.
    Held = 11;
    /// Going on after a hold.
    Unholding = 12;
    /// Coming to a wait for something from outside.
    Suspending = 13;
    /// Going on after that.
    Unsuspending = 14;
    /// Getting ready to wait for a start.
    Resetting = 15;
    /// Finishing: the units that were asked for are done.
    Completing = 16;
    /// Finished.
    Completed = 17;
}

impl State {
    /// Its number in the standard.
    pub fn number(self) -> u8 {
        self as u8
    }

    /// Where an acting state leads when what it does is done; `None` for a state that waits for a command.
    pub fn then(self) -> Option<State> {
        Some(match self {
            State::Clearing | State::Stopping => State::Stopped,
            State::Starting | State::Unholding | State::Unsuspending => State::Execute,
            State::Aborting => State::Aborted,
            State::Holding => State::Held,
            State::Suspending => State::Suspended,
            State::Resetting => State::Idle,
            State::Completing => State::Completed,
            State::Stopped | State::Idle | State::Suspended | State::Aborted | State::Held | State::Completed => {
                return None;
            }
            State::Execute => return None, // ends by a command
        })
    }

    /// Where a command leads; `None` if it is not legal here.
    pub fn on(self, command: Command) -> Option<State> {
        use State::*;
        match command {
            Command::Reset => matches!(self, Stopped | Completed).then_some(Resetting),
            Command::Start => (self == Idle).then_some(Starting),
            Command::Stop => (!matches!(self, Clearing | Stopped | Stopping | Aborting | Aborted)).then_some(Stopping),
            Command::Hold => matches!(self, Execute | Suspended).then_some(Holding),
            Command::Unhold => (self == Held).then_some(Unholding),
            Command::Suspend => (self == Execute).then_some(Suspending),
            Command::Unsuspend => (self == Suspended).then_some(Unsuspending),
            Command::Abort => (!matches!(self, Aborting | Aborted)).then_some(Aborting),
            Command::Clear => (self == Aborted).then_some(Clearing),
            Command::Complete => matches!(self, Execute | Held | Suspended).then_some(Completing),
        }
    }
}

/// A command with its number in the standard.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Command {
    /// Get ready to wait for a start.
    Reset = 1,
    /// Work.
    Start = 2,
    /// Come to rest after the act that is under way.
    Stop = 3,
    /// Wait after the act that is under way.
    Hold = 4,
    /// Go on.
    Unhold = 5,
    /// Wait for something from outside.
    Suspend = 6,
    /// It has come.
    Unsuspend = 7,
    /// Come to rest at once.
    Abort = 8,
    /// What caused an abort is mended.
    Clear = 9,
    /// The units that were asked for are done.
    Complete = 10,
}

impl Command {
    /// Every command, by number.
    pub const ALL: [Command; 10] = [
        Command::Reset,
        Command::Start,
        Command::Stop,
        Command::Hold,
        Command::Unhold,
        Command::Suspend,
        Command::Unsuspend,
        Command::Abort,
        Command::Clear,
        Command::Complete,
    ];
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({})", self.name(), self.number())
    }
}

/// A command that is not legal now; nothing has changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{command:?} is not legal in {state}; legal are {}", legal(*state))]
pub struct Illegal {
    /// What was asked for.
    pub command: Command,
    /// In which state.
    pub state: State,
}

fn legal(state: State) -> String {
    let names = Command::ALL.into_iter().filter(|c| state.on(*c).is_some());
    names.map(|c| format!("{c:?}")).collect::<Vec<_>>().join(", ")
}

/// The cell's mode and state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Machine {
    mode: Mode,
    state: State,
}

impl Default for Machine {
    fn default() -> Self {
        Self::new()
    }
}

impl Machine {
    /// As after switching on: production, stopped.
    pub fn new() -> Self {
        Self {
            mode: Mode::Production,
            state: State::Stopped,
        }
    }

    /// The state.
    pub fn state(&self) -> State {
        self.state
    }

    /// The mode.
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// Changes the mode, which is legal at rest only: stopped, idle or aborted.
    ///
    /// # Returns
    /// Whether it was changed.
    pub fn change_mode(&mut self, mode: Mode) -> bool {
        let at_rest = matches!(self.state, State::Stopped | State::Idle | State::Aborted);
        if at_rest {
            self.mode = mode;
        }
        at_rest
    }

    /// Takes a command.
    ///
    /// # Errors
    /// [`Illegal`], with the commands that are legal.
    pub fn command(&mut self, command: Command) -> Result<State, Illegal> {
        let state = self.state;
        let manual = self.mode == Mode::Manual && command == Command::Start;
        let next = state.on(command).filter(|_| !manual);
        self.state = next.ok_or(Illegal { command, state })?;
        Ok(self.state)
    }

    /// The safety chain has opened, or an arm is in alarm: from every state, and no error where that is known already.
    pub fn abort(&mut self) {
        self.state = self.state.on(Command::Abort).unwrap_or(self.state);
    }

    /// What an acting state does is done; nothing happens in a waiting one.
    pub fn done(&mut self) -> State {
        self.state = self.state.then().unwrap_or(self.state);
        self.state
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_numbers_are_the_standards() {
        for (k, state) in State::ALL.into_iter().enumerate() {
            assert_eq!(usize::from(state.number()), k + 1);
        }
        assert_eq!(State::Execute.to_string(), "Execute (6)");
        assert_eq!(State::Aborted.number(), 9);
        assert_eq!(Command::Clear as u8, 9);
    }

    #[test]
    fn work_begins_by_a_start_and_nothing_else() {
        // every way into Execute begins with Start, or goes on where a start was before
        for state in State::ALL {
            for command in Command::ALL {
                let Some(next) = state.on(command) else { continue };
                if next.then() == Some(State::Execute) {
                    let goes_on = matches!(state, State::Held | State::Suspended);
                    assert!(command == Command::Start || goes_on, "{state} on {command:?}");
                }
            }
        }
    }

    #[test]
    fn after_an_abort_the_way_back_is_clear_reset_start() {
        for state in State::ALL {
            let mut machine = Machine {
                mode: Mode::Production,
                state,
            };
            machine.abort();
            machine.done();
            assert_eq!(machine.state(), State::Aborted, "from {state}");
            let mut legal = Command::ALL.into_iter().filter(|c| machine.state().on(*c).is_some());
            assert_eq!((legal.next(), legal.next()), (Some(Command::Clear), None));
            for command in [Command::Clear, Command::Reset, Command::Start] {
                machine.command(command).expect("legal");
                machine.done();
            }
            assert_eq!(machine.state(), State::Execute);
        }
    }

    #[test]
    fn every_acting_state_ends_and_every_waiting_one_has_a_way_on() {
        for state in State::ALL {
            match state.then() {
                Some(next) => assert_ne!(next, state),
                None => assert!(Command::ALL.into_iter().any(|c| state.on(c).is_some()), "{state}"),
            }
        }
        let error = Machine::new()
            .command(Command::Start)
            .expect_err("not reset")
            .to_string();
        assert!(error.contains("Stopped (2)") && error.contains("Reset"), "{error}");
    }

    #[test]
    fn nothing_is_started_in_manual_mode() {
        let mut machine = Machine::new();
        assert!(machine.change_mode(Mode::Manual));
        machine.command(Command::Reset).expect("legal");
        machine.done();
        assert!(machine.command(Command::Start).is_err());
        assert!(machine.change_mode(Mode::Production));
        machine.command(Command::Start).expect("legal");
        assert!(!machine.change_mode(Mode::Manual), "not while it works");
    }
}
