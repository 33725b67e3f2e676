//! Oracles and shared set-up for the tests.
