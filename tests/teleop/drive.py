"""Sits before the window of `teleop`: looks at what it prints, and presses keys."""

import json
import math
import queue
import subprocess
import sys
import threading
import time

program, out, shots = sys.argv[1:4]


class Person:
    def __init__(self):
        command = [program, "--task", "nut_assembly", "--direction", "easy", "--preset", "smoke", "--out", out]
        self.process = subprocess.Popen(command + ["--trace", "--speed", "0.08"], stdout=subprocess.PIPE, text=True)
        self.lines = queue.Queue()
        threading.Thread(target=self.read, daemon=True).start()
        self.keys = subprocess.Popen(["xdotool", "-"], stdin=subprocess.PIPE, text=True)
        self.held = set()
        self.state = None
        self.look(timeout=60)
        found = subprocess.run(
            ["xdotool", "search", "--sync", "--onlyvisible", "--name", "nut_assembly"],
            capture_output=True, text=True, timeout=60, check=True)
        subprocess.run(["xdotool", "windowfocus", found.stdout.split()[0]], check=True)
        time.sleep(1)

    def read(self):
        for line in self.process.stdout:
            self.lines.put(json.loads(line) if line.startswith("{") else line.strip())
        self.lines.put(None)

    def look(self, timeout=10):
        """The newest state; waits for one."""
        new = False
        while not new or not self.lines.empty():
            line = self.lines.get(timeout=timeout)
            assert line is not None, "the program ended"
            if isinstance(line, dict):
                self.state, new = line, True
            else:
                print("teleop:", line)
        return self.state

    def send(self, word, key):
        self.keys.stdin.write(f"{word} {key}\n")
        self.keys.stdin.flush()

    def hold(self, keys):
        for key in self.held - keys:
            self.send("keyup", key)
        for key in keys - self.held:
            self.send("keydown", key)
        self.held = keys

    def tap(self, key, until=lambda state: True):
        self.hold(set())
        self.send("key", key)
        end = time.time() + 20
        while not until(self.look()):
            assert time.time() < end, f"{key}: {self.state}"

    def go(self, x, y, z, yaw):
        end = time.time() + 120
        still = 0
        while still < 5:
            assert time.time() < end, f"not at {x, y, z, yaw}: {self.state}"
            goal = self.look()["goal"]
            errors = [(x - goal[0], "w", "s"), (y - goal[1], "a", "d"), (z - goal[2], "Up", "Down")]
            turn = yaw - self.state["yaw"]
            far = max(abs(e) for e, *_ in errors) > 0.05 or abs(turn) > 0.25
            least, least_turn = (0.04, 0.2) if far else (0.006, 0.04)
            keys = {plus if e > 0 else minus for e, plus, minus in errors if abs(e) > least}
            if abs(turn) > least_turn:
                keys.add("Left" if turn > 0 else "Right")
            still = 0 if keys else still + 1
            if keys and not far:
                keys.add("Shift_L")
            self.hold(keys)

    def shoot(self, name):
        # What is printed is a picture ahead of what is seen.
        time.sleep(1)
        subprocess.run(["import", "-window", "root", f"{shots}/{name}.png"], check=True)

    def home(self):
        self.hold({"g"})
        end = time.time() + 60
        while self.look()["from_home"] > 0.002:
            assert time.time() < end, self.state
        self.hold(set())
        self.look()


person = Person()
person.shoot("practice")
person.tap("b", lambda s: s["phase"] == "Recording")
x, y, _, yaw = person.look()["object"]
turned = yaw - math.pi * round(yaw / math.pi)
handle = (x + 0.14 * math.cos(yaw), y + 0.14 * math.sin(yaw))
person.go(*handle, 0.15, turned)
person.go(*handle, 0.016, turned)
person.tap("space", lambda s: not s["open"])
for _ in range(10):
    person.look()
person.go(*handle, 0.2, turned)
person.shoot("recording")
person.go(0.37, -0.15, 0.2, 0.0)
person.go(0.37, -0.15, 0.018, 0.0)
person.tap("space", lambda s: s["open"])
for _ in range(10):
    person.look()
person.home()
assert person.look()["success"], person.state
person.shoot("success")
person.tap("Return", lambda s: s["saved"] == 1)
person.shoot("saved")
# Killed in the next take: the first one stays.
person.tap("b", lambda s: s["phase"] == "Recording")
person.hold({"Down"})
for _ in range(10):
    person.look()
person.process.kill()
person.process.wait()

person = Person()
assert person.state["saved"] == 1, person.state
person.send("key", "ctrl+q")
assert person.process.wait(20) == 0
