//! A server and its clients: nothing is lost or mixed up, and nobody harms another.

use crate::common::{Client, Slow, actions, direct, entries, message, metric, page, policy, seen, settings};
use e2h_core::Rng;
use e2h_serve::wire::{Array, Value};
use e2h_serve::{Error, Inputs, Seen, Servable, Server, Settings, Token};
use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

const CAMERAS: &[&str] = &["wrist", "table"];

fn asked(k: u64, seed: u64, inputs: &Inputs) -> Value {
    let mut all = entries(&seen(k, inputs), inputs);
    all.push(("seed".to_owned(), seed.into()));
    message(all)
}

#[test]
fn a_thousand_requests_of_eight_clients_among_faulty_ones_get_their_own_answers() {
    let server = Server::start(Box::new(policy(CAMERAS)), settings()).unwrap();
    let inputs = server.inputs().clone();
    let reference = policy(CAMERAS);
    let expected: Vec<Vec<f32>> = (0..125).map(|k| direct(&reference, k, 1000 + k)).collect();
    assert!(expected.windows(2).all(|w| w[0] != w[1]), "answers that differ");
    std::thread::scope(|scope| {
        for c in 0..8_u64 {
            let (server, inputs, expected) = (&server, &inputs, &expected);
            scope.spawn(move || {
                let mut client = Client::new(server);
                for i in 0..125 {
                    let k = (i * 7 + c * 31) % 125;
                    let answer = client.infer(&asked(k, 1000 + k, inputs));
                    assert_eq!(
                        actions(&answer),
                        expected[usize::try_from(k).unwrap()],
                        "client {c}, request {i}"
                    );
                    assert_eq!(answer.get("seed").and_then(Value::as_u64), Some(1000 + k));
                    let timing = answer.get("server_timing").unwrap();
                    assert!(matches!(timing.get("infer_ms"), Some(Value::Float(ms)) if *ms > 0.0));
                    assert_eq!(timing.get("prev_total_ms").is_some(), i > 0);
                }
            });
        }
        let (server, inputs) = (&server, &inputs);
        scope.spawn(move || {
            for i in 0..60_u64 {
                let mut client = Client::new(server);
                let mut request = entries(&seen(i, inputs), inputs);
                match i % 6 {
                    0 => client.send(vec![0xc1, 7, 7]),
                    1 => client.socket.send(tungstenite::Message::Text("hello".into())).unwrap(),
                    2 => {
                        request[0].1 = Array::f32(&[15], &[f32::NAN; 15]).into();
                        client.send(message(request).encode());
                    }
                    3 => {
                        request[1].1 = Array::f32(&[2, 2], &[0.0; 4]).into();
                        client.send(message(request).encode());
                    }
                    4 => {
                        // The first bytes of a frame, and then nothing.
                        client.socket.get_mut().write_all(&[0x82, 0xfe, 0xff, 0xff, 1, 2, 3, 4, 5]).unwrap();
                        continue;
                    }
                    _ => {
                        // Gone before the answer.
                        client.send(message(request).encode());
                        continue;
                    }
                }
                let words = client.error();
                let expected = ["Reserved", "a binary one", "finite numbers", "uint8 from 0 to 255"];
                assert!(words.contains(expected[usize::try_from(i % 6).unwrap()]), "{words}");
            }
        });
    });
    assert!(metric(&server, "e2h_serve_requests_total") >= 1000.0);
    assert_eq!(metric(&server, "e2h_serve_errors_total"), 40.0);
    server.stop();
}

#[test]
fn those_who_wait_are_answered_together() {
    let slow = Slow(policy(&[]), Duration::from_millis(400));
    let server = Server::start(Box::new(slow), Settings { max_batch: 4, ..settings() }).unwrap();
    let inputs = server.inputs().clone();
    let mut clients: Vec<Client> = (0..9).map(|_| Client::new(&server)).collect();
    for (c, client) in (0..).zip(&mut clients) {
        client.send(asked(c, c, &inputs).encode());
    }
    for (c, client) in (0..).zip(&mut clients) {
        let tungstenite::Message::Binary(answer) = client.receive() else { panic!("no answer") };
        assert_eq!(actions(&Value::decode(&answer).unwrap()), direct(&policy(&[]), c, c));
    }
    // While the first ones are answered all others arrive: they take two calls, or three.
    let calls = metric(&server, "e2h_serve_batch_size_count");
    assert!((3.0..=4.0).contains(&calls), "{calls} calls for 9 requests, at most 4 in one");
    assert_eq!(metric(&server, "e2h_serve_batch_size_sum"), 9.0);
    assert_eq!(metric(&server, "e2h_serve_batch_size_bucket{le=\"4\"}"), calls, "a call with more than 4");
    assert_eq!(metric(&server, "e2h_serve_latency_seconds_count"), 9.0);
}

#[test]
fn seeds_repeat_resets_begin_anew_and_streams_come_back() {
    let server = Server::start(Box::new(policy(&[])), settings()).unwrap();
    let inputs = server.inputs().clone();
    let mut client = Client::new(&server);
    let plain = message(entries(&seen(0, &inputs), &inputs));
    let (first, second) = (client.infer(&plain), client.infer(&plain));
    assert_ne!(actions(&first), actions(&second));
    // The seed of an answer makes it again.
    let seed = first.get("seed").and_then(Value::as_u64).unwrap();
    assert_eq!(actions(&client.infer(&asked(0, seed, &inputs))), actions(&first));
    assert_eq!(actions(&first), direct(&policy(&[]), 0, seed));
    let mut reset = entries(&seen(0, &inputs), &inputs);
    reset.push(("reset".to_owned(), Value::Bool(true)));
    let third = client.infer(&message(reset.clone()));
    assert!([&first, &second].iter().all(|a| actions(a) != actions(&third)));
    // Another server of the same seed, asked the same by its first client, says the same.
    let other = Server::start(Box::new(policy(&[])), settings()).unwrap();
    let mut client = Client::new(&other);
    assert_eq!(actions(&client.infer(&plain)), actions(&first));
    assert_eq!(actions(&client.infer(&message(reset))), actions(&third));
}

#[test]
fn a_server_says_what_it_is_and_whether_it_is_well() {
    let server = Server::start(Box::new(policy(CAMERAS)), settings()).unwrap();
    let client = Client::new(&server);
    let m = &client.metadata;
    assert_eq!(m.get("state_width"), Some(&Value::Int(15)));
    assert_eq!(m.get("action_width"), Some(&Value::Int(8)));
    assert_eq!(m.get("n_obs_steps"), Some(&Value::Int(2)));
    assert_eq!(m.get("control_hz"), Some(&Value::Float(20.0)));
    let Some(Value::List(cameras)) = m.get("cameras") else { panic!("{m:?}") };
    assert_eq!(cameras[0].get("name"), Some(&Value::from("wrist")));
    assert_eq!(page(server.address(), "/healthz", ""), ("HTTP/1.1 200 OK".to_owned(), "OK\n".to_owned()));
    assert_eq!(metric(&server, "e2h_serve_clients"), 1.0);
    let (status, _) = page(server.address(), "/", "");
    assert!(status.starts_with("HTTP/1.1 4"), "{status}");
}

#[test]
fn only_who_knows_the_token_is_let_in() {
    let token = Some(Token::new("open sesame").unwrap_err());
    assert!(matches!(token, Some(Error::Setting { .. })));
    let token = Token::new("sesame\n").unwrap();
    assert!(!format!("{token:?}").contains("sesame"));
    let server = Server::start(Box::new(policy(&[])), Settings { token: Some(token), ..settings() }).unwrap();
    let address = server.address();
    for header in [None, Some("Bearer sesam"), Some("Bearer sesamex"), Some("sesame"), Some("Basic sesame")] {
        let refused = Client::with(address, header).err().unwrap();
        assert!(refused.contains("401"), "{header:?}: {refused}");
    }
    for header in ["Bearer sesame", "Api-Key sesame"] {
        assert!(Client::with(address, Some(header)).is_ok(), "{header}");
    }
    assert!(page(address, "/metrics", "").0.contains("401"));
    assert!(page(address, "/metrics", "Authorization: Bearer sesame\r\n").0.contains("200"));
    assert!(page(address, "/healthz", "").0.contains("200"));
}

#[test]
fn others_machines_are_let_in_with_a_token_alone() {
    let listen = SocketAddr::from(([0, 0, 0, 0], 0));
    let start = |token| Server::start(Box::new(policy(&[])), Settings { listen, token, ..settings() });
    let error = start(None).err().unwrap();
    assert!(matches!(error, Error::Open { .. }) && error.to_string().contains("0.0.0.0:0"), "{error}");
    assert!(start(Some(Token::new("sesame").unwrap())).is_ok());
    let none = Settings { max_batch: 0, ..settings() };
    let error = Server::start(Box::new(policy(&[])), none).err().unwrap().to_string();
    assert!(error.contains("max-batch: expected 1 to 1024, found 0"), "{error}");
}

#[test]
fn messages_clients_and_silence_have_limits() {
    let limits =
        Settings { max_message: 1 << 16, max_clients: 3, idle: Duration::from_secs(2), ..settings() };
    let server = Server::start(Box::new(policy(&[])), limits).unwrap();
    let inputs = server.inputs().clone();
    let mut large = Client::new(&server);
    large.send(vec![0; (1 << 16) + 1]);
    let words = large.error();
    assert!(words.contains("of at most 65536 bytes"), "{words}");
    drop(large);
    // Exactly as large as allowed is read, and found to be no message.
    let mut full = Client::new(&server);
    full.send(vec![0xc0; 1 << 16]);
    assert!(full.error().contains("65535 more bytes"));
    drop(full);

    let start = Instant::now();
    let mut silent = Client::new(&server);
    let mut half = Client::new(&server);
    half.socket.get_mut().write_all(&[0x82, 0xfe, 0x10, 0]).unwrap();
    let mut third = Client::new(&server);
    let refused = Client::with(server.address(), None).err().unwrap();
    assert!(refused.contains("503"), "{refused}");
    third.infer(&asked(0, 0, &inputs));
    assert!(silent.error().contains("within 2s"));
    assert!(half.error().contains("within 2s"));
    assert!(start.elapsed() >= Duration::from_secs(2));
}

#[test]
fn an_answer_that_takes_too_long_is_an_error() {
    let slow = Slow(policy(&[]), Duration::from_millis(600));
    let limits = Settings { inference: Duration::from_millis(200), ..settings() };
    let server = Server::start(Box::new(slow), limits).unwrap();
    let mut client = Client::new(&server);
    client.send(asked(0, 0, server.inputs()).encode());
    let words = client.error();
    assert!(words.contains("inference: expected an answer within 200ms"), "{words}");
}

#[test]
fn a_server_that_stops_answers_first_and_says_goodbye() {
    let slow = Slow(policy(&[]), Duration::from_millis(1500));
    let server = Server::start(Box::new(slow), settings()).unwrap();
    let inputs = server.inputs().clone();
    let address = server.address();
    let mut idle = Client::new(&server);
    let mut busy = Client::new(&server);
    busy.send(asked(5, 9, &inputs).encode());
    std::thread::sleep(Duration::from_millis(500));
    let stopping = std::thread::spawn(move || server.stop());
    let tungstenite::Message::Binary(answer) = busy.receive() else { panic!("no answer") };
    assert_eq!(actions(&Value::decode(&answer).unwrap()), direct(&policy(&[]), 5, 9));
    for client in [&mut busy, &mut idle] {
        match client.receive() {
            tungstenite::Message::Close(Some(frame)) => assert_eq!(u16::from(frame.code), 1001),
            other => panic!("expected a close, got {other:?}"),
        }
        // Answers the close.
        let _ = client.socket.read();
    }
    stopping.join().unwrap();
    assert!(TcpStream::connect(address).is_err(), "it still listens");
}

#[test]
fn what_is_no_protocol_is_left() {
    let server = Server::start(Box::new(policy(&[])), settings()).unwrap();
    let mut stream = TcpStream::connect(server.address()).unwrap();
    stream.write_all(b"\x16\x03\x01 not http at all\r\n\r\n").unwrap();
    let mut answer = vec![];
    let _ = stream.read_to_end(&mut answer);
    assert!(answer.is_empty() || answer.starts_with(b"HTTP/1.1 400"), "{answer:?}");
    let mut client = Client::new(&server);
    assert!(!actions(&client.infer(&asked(1, 1, server.inputs()))).is_empty());
}

/// A policy that some observations are too much for.
struct Brittle(e2h_policy::DiffusionPolicy);

impl Servable for Brittle {
    fn inputs(&self) -> Inputs {
        self.0.inputs()
    }

    fn act(&self, histories: Vec<Vec<Seen>>, rngs: &mut [Rng]) -> e2h_serve::Result<Vec<Vec<Vec<f32>>>> {
        std::thread::sleep(Duration::from_millis(30));
        let first: Vec<f32> = histories.iter().map(|h| h[0].state[0]).collect();
        assert!(!first.contains(&100.0), "too much");
        let mut chunks = self.0.act(histories, rngs)?;
        for (chunk, state) in chunks.iter_mut().zip(first) {
            if state > 150.0 {
                chunk[0][0] = f32::NAN;
            }
        }
        Ok(chunks)
    }
}

#[test]
fn an_observation_that_breaks_the_policy_spoils_no_answer_of_others() {
    let server = Server::start(Box::new(Brittle(policy(&[]))), settings()).unwrap();
    let inputs = server.inputs().clone();
    let reference = policy(&[]);
    std::thread::scope(|scope| {
        for c in 0..6_u64 {
            let server = &server;
            scope.spawn(move || {
                for i in 0..4_u16 {
                    let mut client = Client::new(server);
                    let mut state = [0.0; 15];
                    state[0] = 100.0 * f32::from(1 + i % 3);
                    client.send(Value::map([("state", Array::f32(&[15], &state).into())]).encode());
                    let words = client.error();
                    let expected = if i % 3 == 0 { "it panicked" } else { "expected finite actions" };
                    assert!(
                        words.contains("the policy gave no answer") && words.contains(expected),
                        "{c}: {words}"
                    );
                }
            });
        }
        let expected: Vec<Vec<f32>> = (0..12).map(|k| direct(&reference, k, k)).collect();
        let mut client = Client::new(&server);
        for (k, expected) in (0..).zip(&expected) {
            assert_eq!(actions(&client.infer(&asked(k, k, &inputs))), *expected);
        }
    });
    // Some calls were of several, or nothing was put to the test.
    assert!(
        metric(&server, "e2h_serve_batch_size_bucket{le=\"1\"}")
            < metric(&server, "e2h_serve_batch_size_count")
    );
}
