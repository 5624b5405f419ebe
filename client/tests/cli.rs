//! The program's outermost contract. That this file stands beside the program makes `cargo test` build the program itself,
//! which the end-to-end tests of the `tests` crate start.

use std::process::Command;

#[test]
fn the_contract_of_the_command_line_holds() {
    for (arguments, code) in [(&["--version"][..], 0), (&["join", "--help"], 0), (&["render", "--help"], 0), (&["dance"], 2), (&[], 2)] {
        let output = Command::new(env!("CARGO_BIN_EXE_mr360-client")).args(arguments).output().unwrap();
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {output:?}");
    }
}
