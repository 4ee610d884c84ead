// What the guard never lets pass, for every address, value and state of the board.
module guard_properties (
  input write, input [16:0] address, input [3:0] strobe, input [31:0] data, input running, input can_resume,
  input [2:0] ready, input [31:0] done, input [63:0] cycles, input [31:0] target, input [63:0] max_cycles,
  input [63:0] run_until, input [31:0] bank, input [31:0] prior, input [255:0] halt, input bad_input);

  wire [7:0] error;
  wire ring;

  bm1_guard guard (
    .write_i(write), .address_i(address), .strobe_i(strobe), .data_i(data), .running_i(running), .can_resume_i(can_resume),
    .ready_i(ready), .done_i(done), .cycles_i(cycles), .target_i(target), .max_cycles_i(max_cycles),
    .run_until_i(run_until), .bank_i(bank), .prior_i(prior), .halt_i(halt), .bad_input_i(bad_input), .error_o(error),
    .ring_o(ring));

  localparam CONTROL = 17'h100, START = 17'h120, RESUME = 17'h124;

  always @* begin
    // while the machine runs nothing is written but a reset
    if (running && write && error == 0) assert (address == CONTROL && data[0]);
    // parts of words do not exist
    if (error == 0) assert (address[1:0] == 0 && (!write || strobe == 15));
    // a doorbell rings with the number that is due, and never twice: DONE passes it only when the machine has stopped
    if (ring) begin
      assert (write && !running && error == 0);
      assert (address == START || address == RESUME);
      assert (data == (done == 32'hFFFFFFFF ? 1 : done + 1) && data != 0);
      assert (run_until[63] == 0);
      if (address == START) begin
        assert (target != 0 && target < 256 && max_cycles != 0 && max_cycles[63] == 0 && bank < 5 && !bad_input);
      end
      else begin
        assert (can_resume && (run_until == 0 || run_until > cycles));
        assert ((ready & ~halt[2:0]) != 0 && halt[255:3] == 0);
      end
    end
    // reads do not change anything
    if (!write) assert (!ring);
  end
endmodule
