//! Quinn endpoints, certificates and MoQ sessions.
