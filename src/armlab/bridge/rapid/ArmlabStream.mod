MODULE ArmlabStream
  ! Tells a computer where the arm is, every 4 ms, and moves nothing: to watch it, and to lead it by hand.
  ! armlab, MIT licence. Written from ABB's manual 3HAC073318-001 (Externally Guided Motion); never tried on a real
  ! controller. Answers of the computer are not used.
  !
  ! For a YuMi load it into both tasks, with ROB_L and "armlab_l" in T_ROB_L, ROB_R and "armlab_r" in T_ROB_R.

  LOCAL VAR egmident guide;

  PROC main()
    EGMReset guide;
    EGMGetId guide;
    EGMSetupUC ROB_1, guide, "armlab", "armlab" \Joint;
    EGMStreamStart guide \SampleRate:=4;
    TPWrite "armlab: streaming";
    ! To lead the arm by hand: the button or page of the pendant, or take away the next exclamation mark.
    ! SetLeadThrough \On;
    WHILE TRUE DO
      WaitTime 0.5;
    ENDWHILE
  ENDPROC
ENDMODULE
