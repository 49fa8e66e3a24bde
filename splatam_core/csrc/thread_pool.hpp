// A pool of threads: run(task) calls task(0..size-1), one index per thread, and returns when all are done. A render is
// a dozen such tasks, each shorter than waking a thread takes. So a thread polls for the next task for 100 us before it
// sleeps. What a task throws ends that index alone; run() rethrows the first of them when all are done.
#pragma once

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

namespace splatam {

class ThreadPool {
 public:
  explicit ThreadPool(int size) : size_(size) {
    try {
      for (int index = 1; index < size; ++index) threads_.emplace_back([this, index] { work(index); });
    } catch (...) {  // the system has no more threads: those that run would end the process if they were not joined
      stop();
      throw;
    }
  }

  ~ThreadPool() { stop(); }

  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  int size() const { return size_; }

  void run(const std::function<void(int)>& task) {
    if (size_ == 1) return task(0);
    {
      std::lock_guard<std::mutex> lock(mutex_);
      task_ = &task;
      failure_ = nullptr;
      running_.store(size_ - 1, std::memory_order_relaxed);
      generation_.fetch_add(1, std::memory_order_release);
    }
    wake_.notify_all();
    attempt(task, 0);
    // The other threads finish within microseconds of this one, so yielding beats sleeping. They use the task, so they
    // are waited for also when it failed here.
    while (running_.load(std::memory_order_acquire) != 0) std::this_thread::yield();
    if (failure_) std::rethrow_exception(std::exchange(failure_, nullptr));
  }

 private:
  void attempt(const std::function<void(int)>& task, int index) noexcept {
    try {
      task(index);
    } catch (...) {
      std::lock_guard<std::mutex> lock(mutex_);
      if (!failure_) failure_ = std::current_exception();
    }
  }

  void stop() {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      stopping_ = true;
      ++generation_;
    }
    wake_.notify_all();
    for (auto& thread : threads_) thread.join();
  }

  void work(int index) {
    std::uint64_t seen = 0;
    for (;;) {
      const std::function<void(int)>* task;
      poll(seen);
      {
        std::unique_lock<std::mutex> lock(mutex_);
        wake_.wait(lock, [&] { return generation_ != seen; });
        seen = generation_;
        if (stopping_) return;
        task = task_;
      }
      attempt(*task, index);
      running_.fetch_sub(1, std::memory_order_release);
    }
  }

  // Polls for up to 100 us until there is a new task.
  void poll(std::uint64_t seen) const {
    const auto end = std::chrono::steady_clock::now() + std::chrono::microseconds(100);
    while (generation_.load(std::memory_order_acquire) == seen && std::chrono::steady_clock::now() < end)
      std::this_thread::yield();
  }

  const int size_;
  std::vector<std::thread> threads_;
  std::mutex mutex_;
  std::condition_variable wake_;
  const std::function<void(int)>* task_ = nullptr;
  std::exception_ptr failure_;
  std::atomic<std::uint64_t> generation_{0};
  std::atomic<int> running_{0};
  bool stopping_ = false;
};

}  // namespace splatam
